"""Consistency check of a database: content hashes, references, history, triggers."""

from collections import defaultdict
from collections.abc import Iterator
from typing import Final

from sqlalchemy import Connection, Table, inspect, select
from sqlalchemy.orm import Session

from compute.errors import LumilineError
from service.api.calibrations.calibration_content import content_hash
from service.api.devices.store import sensors_of_row, source_of
from service.database.immutability_triggers import missing_triggers
from service.database.migration import newest_revision, revision_of
from service.database.models import (
    ActivationRow,
    ActiveCalibrationRow,
    Base,
    CalibrationRow,
    CorrectionTableRow,
    DeviceRow,
    RadiometricActivationRow,
    RadiometricCalibrationRow,
    RadiometricCaptureRow,
    WaveCaptureRow,
)


def find_inconsistencies(connection: Connection) -> list[str]:
    """Return what is wrong, one line each; none: the database is sound."""
    revision, newest = revision_of(connection), newest_revision()
    if revision != newest:
        return [f"its revision is {revision or 'none'}, and this version's {newest}"]
    broken = missing(connection) or unreadable(connection)
    if broken:
        return broken
    with Session(connection) as session:
        return [
            *_damage(connection),
            *_calibrations(session),
            *_tables(session),
            *_radiometric_calibrations(session),
            *_history(session),
            *_radiometric_history(session),
            *_devices(session),
            *missing_triggers(connection),
        ]


def _damage(connection: Connection) -> Iterator[str]:
    """Yield what SQLite finds by itself; PostgreSQL checks references and pages as it goes."""
    if connection.dialect.name != "sqlite":
        return
    for (line,) in connection.exec_driver_sql("PRAGMA integrity_check"):
        if line != "ok":
            yield f"the file is damaged: {line}"
    for table, row, parent, _ in connection.exec_driver_sql("PRAGMA foreign_key_check"):
        yield f"row {row} of {table} refers to a row of {parent} that is not there"


def _calibrations(session: Session) -> Iterator[str]:
    rows = select(CalibrationRow.id, CalibrationRow.content, CalibrationRow.content_hash)
    for identity, content, stored in session.execute(rows.execution_options(yield_per=20)):
        if content_hash(content) != stored:
            yield f'calibration "{identity}" is not what it was: its content hash differs'


def _radiometric_calibrations(session: Session) -> Iterator[str]:
    table = RadiometricCalibrationRow
    rows = select(table.id, table.content, table.content_hash)
    for identity, content, stored in session.execute(rows.execution_options(yield_per=1)):
        if content_hash(content) != stored:
            name = f'radiometric calibration "{identity}"'
            yield f"{name} is not what it was: its content hash differs"


def _tables(session: Session) -> Iterator[str]:
    stored = session.execute(select(CalibrationRow.id, CalibrationRow.content_hash))
    hashes = {row.id: row.content_hash for row in stored}
    for identity in session.scalars(select(CorrectionTableRow.id)).all():
        row = session.get_one(CorrectionTableRow, identity)
        if row.calibration_hash != hashes.get(row.calibration_id):
            yield f'correction table "{identity}" is of another content than its calibration'
        if _table_hash(row.data) != row.content_hash:
            yield f'correction table "{identity}" is not what it was: its content hash differs'
        session.expunge(row)  # up to 64 MB


def _table_hash(data: bytes) -> str | None:
    from service.api.correction_tables.hdf5_file import read_table  # takes a while to load

    try:
        return read_table(data).content_hash()
    except LumilineError:
        return None


def _devices(session: Session) -> Iterator[str]:
    for row in session.scalars(select(DeviceRow).order_by(DeviceRow.id)):
        for what, read in (("a source", source_of), ("sensors", sensors_of_row)):
            try:
                read(row)
            except (LumilineError, ValueError, TypeError, AttributeError, LookupError):
                yield f'device "{row.id}" has {what} that this version cannot read'


def _history(session: Session) -> Iterator[str]:
    """Yield where a device's moves are no chain that ends at its pointer."""
    last: dict[str, tuple[str | None, str | None]] = defaultdict(lambda: (None, None))
    for row in session.scalars(select(ActivationRow).order_by(ActivationRow.id)):
        if (row.previous_calibration_id, row.previous_table_id) != last[row.device_id]:
            yield f'activation {row.id} of device "{row.device_id}" does not follow the one before'
        last[row.device_id] = (row.calibration_id, row.table_id)
    pointers = {
        row.device_id: (row.calibration_id, row.table_id)
        for row in session.scalars(select(ActiveCalibrationRow))
    }
    for device_id in sorted(last.keys() | pointers.keys()):
        if pointers.get(device_id, (None, None)) != last[device_id]:
            yield f'device "{device_id}" does not use what its last activation says'


def _radiometric_history(session: Session) -> Iterator[str]:
    last: dict[str, str | None] = {}
    rows = select(RadiometricActivationRow).order_by(RadiometricActivationRow.id)
    for row in session.scalars(rows):
        if row.previous_radiometric_id != last.get(row.device_id):
            yield (
                f'radiometric activation {row.id} of device "{row.device_id}" does not follow the '
                "one before"
            )
        last[row.device_id] = row.radiometric_id


_BATCH: Final = 200


def missing(connection: Connection) -> list[str]:
    """Return which tables and columns are not there, one line each."""
    there = inspect(connection)
    names = set(there.get_table_names())
    inconsistencies = []
    for table in Base.metadata.sorted_tables:
        if table.name not in names:
            inconsistencies.append(f"the table {table.name} is missing")
            continue
        columns = {str(column["name"]) for column in there.get_columns(table.name)}
        inconsistencies += [
            f"the column {column.name} of {table.name} is missing"
            for column in table.columns
            if column.name not in columns
        ]
    return inconsistencies


def unreadable(connection: Connection) -> list[str]:
    """Return the first value of each table that means nothing, one line each."""
    return [line for table in Base.metadata.sorted_tables for line in _of_table(connection, table)]


def _of_table(connection: Connection, table: Table) -> Iterator[str]:
    # Not the data, up to 64 MB each, in which any bytes can be read.
    columns = [column for column in table.columns if not any(column is one for one in _DATA)]
    rows = connection.execute(select(*columns), execution_options={"stream_results": True})
    try:
        for _ in rows.partitions(_BATCH):
            pass
    except (ValueError, TypeError) as error:
        yield f"a value of the table {table.name} cannot be read: {error}"


_DATA: Final = tuple(
    row.__table__.columns["data"]
    for row in (CorrectionTableRow, RadiometricCaptureRow, WaveCaptureRow)
)
