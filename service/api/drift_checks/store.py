"""Drift checks in the database: made, kept for as long as their device; never changed."""

import secrets
from datetime import UTC, datetime
from typing import Any

from pydantic import TypeAdapter
from sqlalchemy import Select
from sqlalchemy.orm import Session, defer

from compute.calibration.drift.drift_detection import DriftCheck
from service.api.base_models import from_attributes
from service.api.drift_checks.messages import in_words, moved_sensors, verdict_of
from service.api.drift_checks.schema import (
    DriftCheckDocument,
    DriftCheckSummary,
    NewDriftCheck,
    StationaryMarker,
)
from service.database.engine import Resource
from service.database.models import CalibrationRow, DriftCheckRow
from service.problems.errors import DriftCheckExists, UnknownDriftCheck

_CHECK = TypeAdapter(DriftCheck)
_MARKERS = TypeAdapter(list[StationaryMarker])


DRIFT_CHECKS = Resource(DriftCheckRow, "drift_check", UnknownDriftCheck, DriftCheckExists)


def drift_checks(
    device_id: str | None, calibration_id: str | None, good: bool | None
) -> Select[DriftCheckRow]:
    """Return those that the filter matches, newest first, without their readings."""
    found = DRIFT_CHECKS.newest_first(device_id=device_id, calibration_id=calibration_id, good=good)
    return found.options(defer(DriftCheckRow.points))


def add_drift_check(
    session: Session,
    calibration: CalibrationRow,
    request: NewDriftCheck,
    markers: list[StationaryMarker],
    found: DriftCheck,
) -> DriftCheckRow:
    """Store a drift check; raises DriftCheckExists."""
    row = DriftCheckRow(
        id=request.id or f"drift-{secrets.token_hex(8)}",
        device_id=calibration.device_id,
        calibration_id=calibration.id,
        good=found.good,
        given={
            "against": request.against,
            "markers": len(markers),
            "capture_id": request.capture_id,
            "earlier_capture_id": request.earlier_capture_id,
            "position_sigma_mm": request.position_sigma_mm,
        },
        points=_MARKERS.dump_python(markers, mode="json"),
        result=_CHECK.dump_python(found, mode="json"),
        note=request.note,
        created_at=datetime.now(UTC),
    )
    return DRIFT_CHECKS.insert(session, row)


def markers_of(row: DriftCheckRow) -> list[StationaryMarker]:
    """Return the markers of a stored check."""
    return _MARKERS.validate_python(row.points)


def summary(row: DriftCheckRow) -> DriftCheckSummary:
    """Return the check without its readings."""
    return from_attributes(DriftCheckSummary, row, **_judged(row))


def document(row: DriftCheckRow) -> DriftCheckDocument:
    """Return the check, whole."""
    return from_attributes(DriftCheckDocument, row, **_judged(row))


def _judged(row: DriftCheckRow) -> dict[str, Any]:
    check = _CHECK.validate_python(row.result)
    return row.given | {
        "status": verdict_of(check),
        "moved": moved_sensors(check),
        "in_words": in_words(check),
        "check": check,
    }
