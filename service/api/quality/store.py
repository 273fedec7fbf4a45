"""Quality checks, watches and their samples in the database."""

import secrets
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any, TypeVar

from sqlalchemy import Select, select
from sqlalchemy.orm import InstrumentedAttribute, Session

from service.api.base_models import from_attributes
from service.api.quality.run_check import CheckMeasurement
from service.api.quality.schema import (
    NewPointToPoint,
    NewSinglePoint,
    QualityCheck,
    WatchSample,
    WatchSettings,
)
from service.database.engine import Resource
from service.database.models import QualityCheckRow, WatchRow, WatchSampleRow
from service.problems.errors import QualityCheckExists, UnknownQualityCheck

Row = TypeVar("Row", bound=QualityCheckRow | WatchSampleRow)

FIRST_CHARTED = 100
MAX_CHARTED = 1000
"""Values of a chart; of more the first, which say what is normal, and the newest."""


QUALITY_CHECKS = Resource(QualityCheckRow, "quality_check", UnknownQualityCheck, QualityCheckExists)


def add_check(
    session: Session,
    device_id: str,
    asked: NewSinglePoint | NewPointToPoint,
    measured: CheckMeasurement,
) -> QualityCheckRow:
    """Store a quality check; raises QualityCheckExists."""
    result = asdict(measured)
    row = QualityCheckRow(
        id=asked.id or f"quality-{secrets.token_hex(8)}",
        device_id=device_id,
        calibration_id=measured.calibration_id,
        table_id=measured.table_id,
        kind=asked.kind,
        series=series_of(asked),
        asked=asked.model_dump(mode="json", exclude={"id", "note", "kind"}),
        result={name: result[name] for name in ("result", "points", "left_out", "temperature_c")},
        passed=measured.passed,
        note=asked.note,
        created_at=datetime.now(UTC),
    )
    return QUALITY_CHECKS.insert(session, row)


def series_of(asked: NewSinglePoint | NewPointToPoint) -> str:
    """Return the name of a check's series: checks of one series can be compared."""
    if isinstance(asked, NewSinglePoint):
        which = "the marker" if asked.marker is None else f"marker {asked.marker}"
        at = asked.reference_position_mm
        place = "" if at is None else f" at {at[0]:g}, {at[1]:g}, {at[2]:g} mm"
        return f"single-point, {which}{place}"
    if asked.markers is None:
        which = "two markers"
    else:
        which = f"markers {asked.markers[0]} and {asked.markers[1]}"
    return f"point-to-point, {which}, {asked.reference_mm:g} mm"


def document(row: QualityCheckRow) -> QualityCheck:
    """Return a check as clients see it."""
    return from_attributes(QualityCheck, row, **row.result)


def watch_of(session: Session, device_id: str) -> WatchSettings:
    """Return the settings of a device's drift monitor; the defaults where none are stored."""
    row = session.get(WatchRow, device_id)
    return WatchSettings() if row is None else WatchSettings.model_validate(row.settings)


def set_watch(session: Session, device_id: str, settings: WatchSettings) -> None:
    """Say how a device is watched from now on."""
    row = session.get(WatchRow, device_id)
    if row is None:
        row = WatchRow(device_id=device_id)
        session.add(row)
    row.settings = settings.model_dump(mode="json")
    row.updated_at = datetime.now(UTC)
    session.flush()


def samples(device_id: str | None) -> Select[WatchSampleRow]:
    """Return what the watch saw."""
    found = select(WatchSampleRow)
    return found if device_id is None else found.filter_by(device_id=device_id)


def samples_with(session: Session, **using: str | None) -> list[WatchSampleRow]:
    """Return the first and the newest samples of a calibration and table, oldest first."""
    return _first_and_newest(session, WatchSampleRow, [WatchSampleRow.id], using)


def checks_with(session: Session, **using: str | None) -> list[QualityCheckRow]:
    """Return the first and the newest checks of a calibration and table, oldest first."""
    order = [QualityCheckRow.created_at, QualityCheckRow.id]
    return _first_and_newest(session, QualityCheckRow, order, using)


def _first_and_newest(
    session: Session,
    table: type[Row],
    order: list[InstrumentedAttribute[Any]],
    using: dict[str, str | None],
) -> list[Row]:
    wanted = [getattr(table, name).is_not_distinct_from(value) for name, value in using.items()]
    found = select(table).where(*wanted)
    first = session.scalars(found.order_by(*order).limit(FIRST_CHARTED)).all()
    latest_first = found.order_by(*(column.desc() for column in order))
    newest = session.scalars(latest_first.limit(MAX_CHARTED - FIRST_CHARTED)).all()
    return list({row.id: row for row in (*first, *reversed(newest))}.values())


def sample(row: WatchSampleRow) -> WatchSample:
    """Return a sample as clients see it."""
    return from_attributes(WatchSample, row, measured_at=row.at, duration_s=row.seconds)
