"""Parquet: the rows of the CSV file, typed, with what else is known in the schema's metadata."""

import json
from pathlib import Path
from typing import Any

from service.api.exports.motion_table import MotionTable
from service.api.exports.optional_dependencies import import_optional
from service.api.exports.tidy_columns import NUMBERS, TEXTS, tidy_columns


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
