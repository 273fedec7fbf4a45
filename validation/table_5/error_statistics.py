"""The five error statistics of chapter 5's tables, printed and computed."""

from collections.abc import Mapping
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.result import AxisErrors
from validation.result_tables import Cell, ResultTable
from validation.tests_5_1_to_5_8 import Column
from validation.thesis_data import csv_rows

Array = NDArray[np.float64]

STATISTICS: Final = ("mean", "stand.dev.", "abs. mean", "abs. stand.dev", "abs. max. error")
"""As the tables name them, in their order."""


@cache
def printed(table: str, data_set: str) -> Array:
    """Return the five statistics of X, Y, Z as printed, shape (5, 3) [mm]."""
    found = {
        row["statistic"]: [float(row[f"{axis}_mm"]) for axis in "XYZ"]
        for row in csv_rows("chapter_5_errors.csv")
        if row["table"] == table and row["set"] == data_set
    }
    return np.array([found[statistic] for statistic in STATISTICS])


def statistics_of(errors: AxisErrors) -> Array:
    """Return the five statistics of differences, shape (5, 3) [mm]."""
    mean, deviation = np.array(errors.mean_mm), np.array(errors.standard_deviation_mm)
    absolute, largest = np.array(errors.mean_absolute_mm), np.array(errors.max_absolute_mm)
    n = errors.points
    # Both deviations are about the same squares: n (m^2) + (n - 1) s^2.
    squares = mean**2 + deviation**2 * (n - 1) / n
    of_absolute = np.sqrt(np.maximum(squares - absolute**2, 0.0) * n / (n - 1))
    return np.array([mean, deviation, absolute, of_absolute, largest])


def statistics_tables(title: str, columns: Mapping[str, Array | None]) -> tuple[ResultTable, ...]:
    """Return a table for each of X, Y, Z, of columns (5, 3) side by side; None: no figures."""
    return tuple(
        ResultTable(
            f"{axis}: {title}, mm",
            ("", *columns),
            tuple(
                (name, *(_cell(column, row, index) for column in columns.values()))
                for row, name in enumerate(STATISTICS)
            ),
        )
        for index, axis in enumerate("XYZ")
    )


def of_column(column: Column) -> Array | None:
    """Return a case's column as statistics; None where it has no errors."""
    return None if column.errors is None else statistics_of(column.errors)


def _cell(column: Array | None, row: int, index: int) -> Cell:
    return None if column is None else float(column[row, index])
