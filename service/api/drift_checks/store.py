"""Drift checks in the database: made, kept for as long as their device; never changed."""

import secrets
from datetime import UTC, datetime
from typing import Any

from pydantic import TypeAdapter
from sqlalchemy import Select, select
from sqlalchemy.orm import Session, defer

from compute.calibration.drift.drift_detection import DriftCheck
from service.api.drift_checks.messages import in_words, moved_sensors, verdict_of
from service.api.drift_checks.schema import (
    DriftCheckDocument,
    DriftCheckSummary,
    NewDriftCheck,
    StationaryMarker,
)
from service.database.engine import insert
from service.database.models import CalibrationRow, DriftCheckRow
from service.problems.errors import DriftCheckExists, UnknownDriftCheck

_CHECK = TypeAdapter(DriftCheck)
_MARKERS = TypeAdapter(list[StationaryMarker])


def get_drift_check(session: Session, check_id: str) -> DriftCheckRow:
    """Return a drift check; raises UnknownDriftCheck."""
    row = session.get(DriftCheckRow, check_id)
    if row is None:
        raise UnknownDriftCheck(
            f'there is no drift check "{check_id}"; GET /api/v1/drift-checks lists them',
            drift_check=check_id,
        )
    return row


def drift_checks(
    device_id: str | None, calibration_id: str | None, good: bool | None
) -> Select[DriftCheckRow]:
    """Return those that the filter matches, newest first, without their readings."""
    found = (
        select(DriftCheckRow)
        .options(defer(DriftCheckRow.points))
        .order_by(DriftCheckRow.created_at.desc(), DriftCheckRow.id)
    )
    if device_id is not None:
        found = found.where(DriftCheckRow.device_id == device_id)
    if calibration_id is not None:
        found = found.where(DriftCheckRow.calibration_id == calibration_id)
    if good is not None:
        found = found.where(DriftCheckRow.good == good)
    return found


def check_unused(session: Session, check_id: str | None) -> None:
    """Raise DriftCheckExists when the id that a client chose is taken."""
    if check_id is not None and session.get(DriftCheckRow, check_id) is not None:
        raise _exists(check_id)


def _exists(check_id: str) -> DriftCheckExists:
    return DriftCheckExists(
        f'drift check "{check_id}" exists already; choose another id, or leave it out',
        drift_check=check_id,
    )


def add_drift_check(
    session: Session,
    calibration: CalibrationRow,
    request: NewDriftCheck,
    markers: list[StationaryMarker],
    found: DriftCheck,
) -> DriftCheckRow:
    """Store what was found; raises DriftCheckExists."""
    check_unused(session, request.id)
    row = DriftCheckRow(
        id=request.id or f"drift-{secrets.token_hex(8)}",
        device_id=calibration.device_id,
        calibration_id=calibration.id,
        good=found.good,
        given={
            "against": request.against,
            "markers": len(markers),
            "capture": request.capture,
            "earlier_capture": request.earlier_capture,
            "position_sigma_mm": request.position_sigma_mm,
        },
        points=_MARKERS.dump_python(markers, mode="json"),
        result=_CHECK.dump_python(found, mode="json"),
        note=request.note,
        created_at=datetime.now(UTC),
    )
    insert(session, row, _exists(row.id))
    return row


def markers_of(row: DriftCheckRow) -> list[StationaryMarker]:
    """Return the markers of a stored check."""
    return _MARKERS.validate_python(row.points)


def summary(row: DriftCheckRow) -> DriftCheckSummary:
    """Return the check without its readings."""
    return DriftCheckSummary.model_validate(_members(row))


def document(row: DriftCheckRow) -> DriftCheckDocument:
    """Return the check, whole."""
    return DriftCheckDocument.model_validate(_members(row) | {"points": row.points})


def _members(row: DriftCheckRow) -> dict[str, Any]:
    check = _CHECK.validate_python(row.result)
    return row.given | {
        "id": row.id,
        "device": row.device_id,
        "calibration": row.calibration_id,
        "verdict": verdict_of(check),
        "moved": moved_sensors(check),
        "in_words": in_words(check),
        "note": row.note,
        "created_at": row.created_at,
        "check": check,
    }
