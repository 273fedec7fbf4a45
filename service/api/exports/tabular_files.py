"""CSV and Parquet: one row for each point, track and tool in each frame."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.api.exports.motion_table import MotionTable
from service.api.exports.optional_dependencies import import_optional
from service.api.exports.tidy_columns import NUMBERS, TEXTS, tidy_columns

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


def write_parquet(table: MotionTable, path: Path) -> None:
    """Write all of a table.

    Raises:
        MissingLibrary: pyarrow is not installed.
    """
    pa, parquet = import_optional("pyarrow"), import_optional("pyarrow.parquet")
    columns = tidy_columns(table)
    arrays = [_array(pa, name, column) for name, column in columns.items()]
    facts = {
        "device": table.device,
        "rate_hz": table.rate_hz,
        "frames": len(table),
        "lengths": "mm",
        "times": "ns",
        **table.notes,
    }
    whole = pa.Table.from_arrays(arrays, names=list(columns)).replace_schema_metadata(
        {"lumiline": json.dumps(facts)}
    )
    parquet.write_table(whole, path)


def _array(pa: Any, name: str, column: Any) -> Any:
    if name in TEXTS:
        return pa.array(column.tolist(), pa.string()).dictionary_encode()
    # What is no number is null: it is not known, and no result of a computation.
    return pa.array(column, from_pandas=name in NUMBERS)
