"""Tables of coefficients and errors that Tables 5.10 to 5.14 share."""

import numpy as np
from numpy.typing import NDArray

from validation.result_tables import Cell, ResultTable
from validation.table_5.calibration_frame import (
    SENSORS,
    error_mm2,
)
from validation.thesis_methods.eleven_parameter_bundle import (
    PARAMETER_ORDER,
)

Array = NDArray[np.float64]


Worked = tuple[tuple[ResultTable, ...], tuple[str, ...]]


def labelled_rows(labels: tuple[str, ...], values: Array) -> list[tuple[Cell, ...]]:
    """Return rows of a label and four sensors; values of shape (labels, 4)."""
    return [
        (label, *(float(value) for value in row)) for label, row in zip(labels, values, strict=True)
    ]


def error_table(sets: dict[str, Array]) -> ResultTable:
    """Return the errors E of [5.28] of sets of coefficients, four sensors each."""
    rows = labelled_rows(
        tuple(sets),
        np.array([[error_mm2(values[k], k) for k in range(4)] for values in sets.values()]),
    )
    return ResultTable(
        "E of [5.28] on the measured readings of the frame at 1 m (Test 5.4), mm^2",
        ("coefficients", *SENSORS),
        tuple(rows),
    )


def coefficient_table(title: str, sets: dict[str, Array]) -> ResultTable:
    """Return the coefficients of sets side by side, four sensors each."""
    rows: list[tuple[Cell, ...]] = [
        (name, label, *(float(values[k, index]) for k in range(4)))
        for index, name in enumerate(PARAMETER_ORDER)
        for label, values in sets.items()
    ]
    return ResultTable(title, ("", "of", *SENSORS), tuple(rows))
