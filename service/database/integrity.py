"""Whether all tables of a database are there, and each value of them can be read."""

from collections.abc import Iterator
from typing import Final

from sqlalchemy import Connection, Table, inspect, select

from service.database.models import Base, CorrectionTableRow

_BATCH: Final = 200


def missing(connection: Connection) -> list[str]:
    """Return which tables and columns are not there, one line each."""
    there = inspect(connection)
    names = set(there.get_table_names())
    found = []
    for table in Base.metadata.sorted_tables:
        if table.name not in names:
            found.append(f"the table {table.name} is missing")
            continue
        columns = {str(column["name"]) for column in there.get_columns(table.name)}
        found += [
            f"the column {column.name} of {table.name} is missing"
            for column in table.columns
            if column.name not in columns
        ]
    return found


def unreadable(connection: Connection) -> list[str]:
    """Return the first value of each table that means nothing, one line each."""
    return [line for table in Base.metadata.sorted_tables for line in _of_table(connection, table)]


def _of_table(connection: Connection, table: Table) -> Iterator[str]:
    # Not the tables' data, up to 64 MB each, in which any bytes can be read.
    columns = [column for column in table.columns if column is not _DATA]
    found = connection.execute(select(*columns), execution_options={"stream_results": True})
    try:
        for _ in found.partitions(_BATCH):
            pass
    except (ValueError, TypeError) as error:
        yield f"a value of the table {table.name} cannot be read: {error}"


_DATA: Final = CorrectionTableRow.__table__.columns["data"]
