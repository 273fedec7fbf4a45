"""CSV: one row for each point, track and tool in each frame; empty cells where there is nothing."""

import csv
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.api.exports.motion_table import MotionTable
from service.api.exports.tidy_columns import NUMBERS, tidy_columns

_ROWS = 10_000


def write_csv(table: MotionTable, path: Path) -> None:
    """Write all of a table; numbers with as many digits as give the same number again."""
    columns = tidy_columns(table)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        for first in range(0, len(columns["frame"]), _ROWS):
            part = [
                _cells(column[first : first + _ROWS], empty=name in NUMBERS)
                for name, column in columns.items()
            ]
            writer.writerows(zip(*part, strict=True))


def _cells(column: NDArray[Any], *, empty: bool) -> list[Any]:
    values: list[Any] = column.tolist()
    if not empty or np.isfinite(column).all():
        return values
    return [value if value == value else "" for value in values]
