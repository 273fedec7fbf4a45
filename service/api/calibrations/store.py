"""Calibrations in the database: created, read, activated, retired; never changed."""

import secrets
from datetime import UTC, datetime
from typing import Any

import numpy as np
from sqlalchemy import Select, select
from sqlalchemy.orm import Session

from service.api.calibrations.calibration_content import Outcome, observations, result_of
from service.api.calibrations.comparison import CalibrationWithControlPoints
from service.api.calibrations.schema import CalibrationSummary, ControlPoint, State
from service.api.devices.activation import (
    Target,
    active,
    check_not_retired,
    lock_device,
    move_pointer,
)
from service.api.devices.sensor import Sensor
from service.database.engine import insert
from service.database.models import ActiveCalibrationRow, CalibrationRow
from service.problems.errors import (
    CalibrationActive,
    CalibrationExists,
    UnknownCalibration,
)


def get_calibration(session: Session, calibration_id: str) -> CalibrationRow:
    """Return a calibration; raises UnknownCalibration."""
    row = session.get(CalibrationRow, calibration_id)
    if row is None:
        raise UnknownCalibration(
            f'there is no calibration "{calibration_id}"; GET /api/v1/calibrations lists them',
            calibration=calibration_id,
        )
    return row


def active_id(session: Session, device_id: str) -> str | None:
    """Return the id of the device's active calibration, None without one."""
    pointer = active(session, device_id)
    return pointer.calibration_id if pointer is not None else None


def calibrations(device_id: str | None, state: State | None) -> Select[CalibrationRow]:
    """Return those that the filter matches, newest first."""
    active = select(ActiveCalibrationRow.calibration_id)
    found = select(CalibrationRow).order_by(CalibrationRow.created_at.desc(), CalibrationRow.id)
    if device_id is not None:
        found = found.where(CalibrationRow.device_id == device_id)
    if state == "active":
        found = found.where(CalibrationRow.id.in_(active))
    elif state == "retired":
        found = found.where(CalibrationRow.retired_at.is_not(None))
    elif state == "available":
        found = found.where(CalibrationRow.retired_at.is_(None), CalibrationRow.id.not_in(active))
    return found


def check_unused(session: Session, calibration_id: str | None) -> None:
    """Raise CalibrationExists when the id that a client chose is taken."""
    if calibration_id is not None and session.get(CalibrationRow, calibration_id) is not None:
        raise _exists(calibration_id)


def _exists(calibration_id: str) -> CalibrationExists:
    return CalibrationExists(
        f'calibration "{calibration_id}" exists already and is never overwritten; choose '
        "another id, or leave it out",
        calibration=calibration_id,
    )


def add_calibration(
    session: Session, device_id: str, outcome: Outcome, note: str, calibration_id: str | None = None
) -> CalibrationRow:
    """Store a calibration; it is available, not active. Raises CalibrationExists."""
    check_unused(session, calibration_id)
    row = CalibrationRow(
        id=calibration_id or f"cal-{secrets.token_hex(8)}",
        device_id=device_id,
        method=outcome.result.method,
        provenance=outcome.content["provenance"],
        note=note,
        point_count=len(outcome.content["points"]),
        content=outcome.content,
        errors=outcome.errors,
        content_hash=outcome.content_hash,
        created_at=datetime.now(UTC),
        retired_at=None,
    )
    insert(session, row, taken=_exists(row.id))
    return row


def activate(session: Session, calibration_id: str, actor: str | None = None) -> CalibrationRow:
    """Point the device to this calibration, without a table, and write the move down.

    Activating what is active already changes nothing and writes nothing, and keeps its table.

    Raises:
        UnknownCalibration, CalibrationRetired.
    """
    row = usable(session, calibration_id)
    if active_id(session, row.device_id) != row.id:
        move_pointer(session, row.device_id, Target(row.id), actor)
    return row


def usable(session: Session, calibration_id: str) -> CalibrationRow:
    """Return a calibration that is not retired, and lock its device.

    Raises:
        UnknownCalibration, CalibrationRetired.
    """
    row = get_calibration(session, calibration_id)
    lock_device(session, row.device_id)
    session.refresh(row)
    check_not_retired(row)
    return row


def retire(session: Session, calibration_id: str) -> CalibrationRow:
    """Retire a calibration for good; retiring it again changes nothing.

    Raises:
        UnknownCalibration, CalibrationActive.
    """
    row = get_calibration(session, calibration_id)
    lock_device(session, row.device_id)
    session.refresh(row)
    if active_id(session, row.device_id) == row.id:
        raise CalibrationActive(
            f'calibration "{row.id}" is the active one of device "{row.device_id}"; activate '
            "another one before retiring it",
            calibration=row.id,
            device=row.device_id,
        )
    if row.retired_at is None:
        row.retired_at = datetime.now(UTC)
        session.flush()
    return row


def state_of(session: Session, row: CalibrationRow) -> State:
    """Return the calibration's state."""
    if row.retired_at is not None:
        return "retired"
    return "active" if active_id(session, row.device_id) == row.id else "available"


def summary(session: Session, row: CalibrationRow) -> CalibrationSummary:
    """Return the calibration without its numbers."""
    return CalibrationSummary.model_validate(_members(session, row))


def document(session: Session, row: CalibrationRow) -> dict[str, Any]:
    """Return the calibration, whole, as the JSON object of a CalibrationDocument.

    The members that are hashed are as they were stored: what an earlier version stored has no
    members that came later, and they would not be in its hash.
    """
    shown = summary(session, row).model_dump(mode="json")
    return shown | {"parent": None} | row.content | {"errors": row.errors}


def _members(session: Session, row: CalibrationRow) -> dict[str, object]:
    return {
        "id": row.id,
        "device": row.device_id,
        "state": state_of(session, row),
        "provenance": row.provenance,
        "method": row.method,
        "note": row.note,
        "point_count": row.point_count,
        "content_hash": row.content_hash,
        "created_at": row.created_at,
        "retired_at": row.retired_at,
    }


def with_control_points(row: CalibrationRow, sensors: list[Sensor]) -> CalibrationWithControlPoints:
    """Return a calibration of these sensors with the points that it is judged on."""
    points = [ControlPoint.model_validate(point) for point in row.content["points"]]
    held = observations(points, sensors)
    left_out = row.errors["leave_one_out"]
    return CalibrationWithControlPoints(
        result_of(row.content),
        np.array([point.position_mm for point in points], dtype=np.float64).reshape(-1, 3),
        held.readings_px,
        None
        if left_out is None
        else np.array(
            [(np.nan,) * 3 if row is None else row for row in left_out["differences_mm"]],
            dtype=np.float64,
        ).reshape(-1, 3),
    )
