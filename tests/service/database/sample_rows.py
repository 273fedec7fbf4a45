"""A row for every table of a database, whatever its columns; and all rows, to be compared."""

from datetime import datetime, timedelta, timezone
from typing import Any

from sqlalchemy import (
    JSON,
    Boolean,
    Connection,
    DateTime,
    Double,
    Float,
    Integer,
    LargeBinary,
    MetaData,
    String,
    Table,
    Text,
    insert,
    select,
)

from service.database.models import TRANSIENT, Base

_REFERRED = {
    "device_id": "devices",
    "calibration_id": "calibrations",
    "table_id": "correction_tables",
    "tool_id": "tools",
    "radiometric_id": "radiometric_calibrations",
}

Rows = dict[str, list[dict[str, Any]]]

_AWKWARD = "ä\"'\\ \u2028 \U0001f4a1"


def fill(connection: Connection, count: int = 2) -> None:
    """Insert rows into every empty table; they refer to rows that were there, or are new."""
    there: dict[str, Any] = {}
    for table in Base.metadata.sorted_tables:
        first = connection.execute(select(table).limit(1)).first()
        if first is not None:
            there[table.name] = getattr(first, "id", None)
            continue
        # One row where all rows would have the one id that is there.
        rows: dict[tuple[Any, ...], dict[str, Any]] = {}
        for number in range(count):
            row = {one.name: _value(table, one.name, number, there) for one in table.columns}
            rows.setdefault(tuple(row[one.name] for one in table.primary_key), row)
        connection.execute(insert(table), list(rows.values()))


def _value(table: Table, name: str, number: int, there: dict[str, Any]) -> Any:
    column = table.columns[name]
    # Ids and what refers to them; all other texts are awkward ones.
    if name == "id" or name.endswith("_id"):
        if isinstance(column.type, Integer):
            return number + 1
        referred = _REFERRED.get(name.removeprefix("previous_"), table.name)
        return there.get(referred) or f"{referred.replace('_', '-')}-{number}"
    moment = datetime(2024, 2, 29, 23, 59, 59, 123456, tzinfo=timezone(timedelta(hours=5)))
    values: list[tuple[type, Any]] = [
        (LargeBinary, bytes(range(256)) * (number + 1)),
        (Text, _AWKWARD * 3),
        (JSON, {"text": _AWKWARD, "list": [0.1, 1e-300, -(2**53), None, True, {}], "n": number}),
        (Boolean, bool(number % 2)),
        (Integer, 7 + number),
        (Double, 1 / 3 + number),
        (Float, 0.5),
        (DateTime, moment + timedelta(microseconds=number)),
        (String, f"{number}{_AWKWARD}"[: getattr(column.type, "length", None) or 10]),
    ]
    impl = getattr(column.type, "impl", column.type)
    return next(value for kind, value in values if isinstance(impl, kind))


def content(connection: Connection) -> Rows:
    """Return all rows that outlive the servers, as the models read them."""
    return {
        table.name: _rows(connection, table)
        for table in Base.metadata.sorted_tables
        if TRANSIENT not in table.info
    }


def reflected(connection: Connection) -> Rows:
    """Return all rows of the tables that there are, whatever the revision."""
    metadata = MetaData()
    metadata.reflect(connection)
    return {
        table.name: _rows(connection, table)
        for table in metadata.sorted_tables
        if table.name != "alembic_version"
    }


def _rows(connection: Connection, table: Table) -> list[dict[str, Any]]:
    query = select(table).order_by(*table.primary_key.columns)
    return [dict(row) for row in connection.execute(query).mappings()]


def common(one: Rows, other: Rows) -> tuple[Rows, Rows]:
    """Return the tables and columns that both have."""
    pairs = {
        name: [set(row) for rows in (one[name], other[name]) for row in rows[:1]]
        for name in one.keys() & other.keys()
    }
    shared = {name: set.intersection(*found) if found else set() for name, found in pairs.items()}

    def cut(rows: Rows) -> Rows:
        return {
            name: [{key: row[key] for key in sorted(keys)} for row in rows[name]]
            for name, keys in shared.items()
        }

    return cut(one), cut(other)
