"""Quality checks, watches and their samples in the database."""

import secrets
from collections.abc import Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any, TypeVar

from sqlalchemy import Select, select
from sqlalchemy.orm import Session

from service.api.quality.run_check import CheckMeasurement
from service.api.quality.schema import (
    NewPointToPoint,
    NewSinglePoint,
    QualityCheck,
    WatchSample,
    WatchSettings,
)
from service.database.engine import insert
from service.database.models import QualityCheckRow, WatchRow, WatchSampleRow
from service.problems.errors import QualityCheckExists, UnknownQualityCheck

Row = TypeVar("Row", bound=QualityCheckRow | WatchSampleRow)

FIRST_CHARTED = 100
MAX_CHARTED = 1000
"""Values of a chart; of more the first, which say what is normal, and the newest."""


def get_check(session: Session, check_id: str) -> QualityCheckRow:
    """Return a quality check; raises UnknownQualityCheck."""
    row = session.get(QualityCheckRow, check_id)
    if row is None:
        raise UnknownQualityCheck(
            f'there is no quality check "{check_id}"; GET /api/v1/quality-checks lists them',
            quality_check=check_id,
        )
    return row


def checks(device_id: str | None, kind: str | None) -> Select[QualityCheckRow]:
    """Return those that the filter matches, newest first."""
    found = select(QualityCheckRow).order_by(QualityCheckRow.created_at.desc(), QualityCheckRow.id)
    if device_id is not None:
        found = found.where(QualityCheckRow.device_id == device_id)
    if kind is not None:
        found = found.where(QualityCheckRow.kind == kind)
    return found


def check_unused(session: Session, check_id: str | None) -> None:
    """Raise QualityCheckExists when the id that a client chose is taken."""
    if check_id is not None and session.get(QualityCheckRow, check_id) is not None:
        raise _exists(check_id)


def _exists(check_id: str) -> QualityCheckExists:
    return QualityCheckExists(
        f'quality check "{check_id}" exists already; choose another id, or leave it out',
        quality_check=check_id,
    )


def add_check(
    session: Session,
    device_id: str,
    asked: NewSinglePoint | NewPointToPoint,
    measured: CheckMeasurement,
) -> QualityCheckRow:
    """Store what was measured; raises QualityCheckExists."""
    check_unused(session, asked.id)
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
    insert(session, row, _exists(row.id))
    return row


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


def delete_check(session: Session, check_id: str) -> None:
    """Delete a quality check; raises UnknownQualityCheck."""
    session.delete(get_check(session, check_id))
    session.flush()


def document(row: QualityCheckRow) -> QualityCheck:
    """Return a check as clients see it."""
    members: dict[str, Any] = {
        "id": row.id,
        "device": row.device_id,
        "kind": row.kind,
        "calibration_id": row.calibration_id,
        "table_id": row.table_id,
        "asked": row.asked,
        "passed": row.passed,
        "note": row.note,
        "created_at": row.created_at,
    }
    return QualityCheck.model_validate(members | row.result)


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
    """Return what the watch saw, newest first."""
    found = select(WatchSampleRow).order_by(WatchSampleRow.id.desc())
    return found if device_id is None else found.where(WatchSampleRow.device_id == device_id)


def samples_with(
    session: Session, device_id: str, calibration_id: str, table_id: str | None
) -> list[WatchSampleRow]:
    """Return the first and the newest samples of a calibration and table, oldest first."""
    found = (
        select(WatchSampleRow)
        .where(WatchSampleRow.device_id == device_id)
        .where(WatchSampleRow.calibration_id == calibration_id)
        .where(WatchSampleRow.table_id.is_not_distinct_from(table_id))
    )
    first = session.scalars(found.order_by(WatchSampleRow.id).limit(FIRST_CHARTED)).all()
    newest = found.order_by(WatchSampleRow.id.desc()).limit(MAX_CHARTED - FIRST_CHARTED)
    return _joined(first, session.scalars(newest).all())


def checks_with(
    session: Session, device_id: str, calibration_id: str, table_id: str | None
) -> list[QualityCheckRow]:
    """Return the first and the newest checks of a calibration and table, oldest first."""
    found = (
        select(QualityCheckRow)
        .where(QualityCheckRow.device_id == device_id)
        .where(QualityCheckRow.calibration_id == calibration_id)
        .where(QualityCheckRow.table_id.is_not_distinct_from(table_id))
    )
    at, name = QualityCheckRow.created_at, QualityCheckRow.id
    first = session.scalars(found.order_by(at, name).limit(FIRST_CHARTED)).all()
    newest = found.order_by(at.desc(), name.desc()).limit(MAX_CHARTED - FIRST_CHARTED)
    return _joined(first, session.scalars(newest).all())


def _joined(first: Sequence[Row], newest: Sequence[Row]) -> list[Row]:
    """Return rows, oldest first, and the newest of them, newest first, as one list."""
    rows = {row.id: row for row in (*first, *reversed(newest))}
    return list(rows.values())


def sample(row: WatchSampleRow) -> WatchSample:
    """Return a sample as clients see it."""
    members = {name: getattr(row, name) for name in WatchSample.model_fields if name != "device"}
    return WatchSample.model_validate(members | {"device": row.device_id})
