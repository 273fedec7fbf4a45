"""Copies all rows between two databases of either kind."""

from collections.abc import Callable
from typing import Final

from sqlalchemy import Connection, Table, func, insert, select, text

from service.database.models import (
    TRANSIENT,
    Base,
    CorrectionTableRow,
    RadiometricCalibrationRow,
    RadiometricCaptureRow,
    WaveCaptureRow,
)

_BATCH: Final = 200
_LARGE: Final = frozenset(
    row.__tablename__
    for row in (
        CorrectionTableRow,
        RadiometricCalibrationRow,
        RadiometricCaptureRow,
        WaveCaptureRow,
    )
)
"""Tables of which a row may have 64 MB, or many rows some 100 kB each."""

TableCopied = Callable[[str, int], None]


def _kept_tables() -> list[Table]:
    """Return the tables that outlive the servers."""
    return [table for table in Base.metadata.sorted_tables if TRANSIENT not in table.info]


def copy_rows(
    source: Connection, target: Connection, report: TableCopied | None = None
) -> dict[str, int]:
    """Copy the tables into the empty ones of ``target``; return how many rows each has.

    Not those of the servers that run now.

    Both are of the newest revision. ``report`` hears of each table that is done.
    """
    counts = {}
    for table in _kept_tables():
        counts[table.name] = _copy_table(source, target, table)
        if report is not None:
            report(table.name, counts[table.name])
    if target.dialect.name == "postgresql":
        _reset_sequences(target)
    return counts


def count_rows(connection: Connection) -> dict[str, int]:
    """Return how many rows each table has."""
    return {
        table.name: connection.scalar(select(func.count()).select_from(table)) or 0
        for table in _kept_tables()
    }


def _copy_table(source: Connection, target: Connection, table: Table) -> int:
    batch = 1 if table.name in _LARGE else _BATCH
    query = select(table).order_by(*table.primary_key.columns)
    copied = 0
    result = source.execution_options(stream_results=True).execute(query)
    for rows in result.mappings().partitions(batch):
        target.execute(insert(table), [dict(row) for row in rows])
        copied += len(rows)
    return copied


def _reset_sequences(target: Connection) -> None:
    """Let PostgreSQL number new rows after those that came with their numbers."""
    for table in Base.metadata.sorted_tables:
        for column in table.primary_key.columns:
            name = target.scalar(
                text("SELECT pg_get_serial_sequence(:table, :column)"),
                {"table": table.name, "column": column.name},
            )
            if name is not None:
                last = target.scalar(select(func.max(column)))
                target.execute(
                    text("SELECT setval(:name, :next, false)"),
                    {"name": name, "next": (last or 0) + 1},
                )
