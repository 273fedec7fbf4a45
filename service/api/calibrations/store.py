"""Calibrations in the database: created, read, activated, retired, deleted; never changed."""

import secrets
from datetime import UTC, datetime
from itertools import count
from typing import Any, Final

import numpy as np
from sqlalchemy import Select, select
from sqlalchemy.orm import Session

from compute.calibration.result import Calibration
from service.api.base_models import from_attributes
from service.api.calibrations.calibration_content import (
    CalibrationRecord,
    calibration_content,
    observations,
    optional_rows,
    result_of,
)
from service.api.calibrations.comparison import CalibrationWithControlPoints
from service.api.calibrations.schema import (
    CalibratedProfile,
    CalibrationSummary,
    ControlPoint,
    ControlPointErrors,
    State,
)
from service.api.devices.schema import Sensor
from service.api.devices.store import (
    Target,
    active,
    check_not_retired,
    lock_device,
    move_pointer,
)
from service.database.engine import Resource
from service.database.models import (
    ActivationRow,
    ActiveCalibrationRow,
    CalibrationRow,
    CorrectionTableRow,
    DriftCheckRow,
    QualityCheckRow,
    ReconstructionRow,
)
from service.database.referrers import refuse_if_referred
from service.problems.errors import (
    CalibrationActive,
    CalibrationExists,
    CalibrationInUse,
    UnknownCalibration,
)

MAX_ID_CHARACTERS: Final = 63

CALIBRATIONS = Resource(
    CalibrationRow,
    "calibration",
    UnknownCalibration,
    CalibrationExists,
    taken="exists already and is never overwritten; choose another id, or leave it out",
)
get_calibration = CALIBRATIONS.get


def active_id(session: Session, device_id: str) -> str | None:
    """Return the id of the device's active calibration, None without one."""
    pointer = active(session, device_id)
    return pointer.calibration_id if pointer is not None else None


def calibrations(device_id: str | None, state: State | None) -> Select[CalibrationRow]:
    """Return those that the filter matches, newest first."""
    active = select(ActiveCalibrationRow.calibration_id)
    found = CALIBRATIONS.newest_first(device_id=device_id)
    if state == "active":
        found = found.where(CalibrationRow.id.in_(active))
    elif state == "retired":
        found = found.where(CalibrationRow.retired_at.is_not(None))
    elif state == "available":
        found = found.where(CalibrationRow.retired_at.is_(None), CalibrationRow.id.not_in(active))
    return found


def add_calibration(
    session: Session,
    device_id: str,
    record: CalibrationRecord,
    note: str,
    calibration_id: str | None = None,
) -> CalibrationRow:
    """Store a calibration; it is available, not active. Raises CalibrationExists."""
    row = CalibrationRow(
        id=calibration_id or f"cal-{secrets.token_hex(8)}",
        device_id=device_id,
        method=record.result.method,
        provenance=record.content["provenance"],
        note=note,
        point_count=len(record.content["points"]),
        content=record.content,
        errors=record.errors,
        content_hash=record.content_hash,
        created_at=datetime.now(UTC),
        retired_at=None,
    )
    return CALIBRATIONS.insert(session, row)


def unused_nominal_id(session: Session, device_id: str) -> str:
    """Return an id for a nominal calibration of a device that no calibration has."""
    for number in count(1):
        tail = "-nominal" if number == 1 else f"-nominal-{number}"
        found = device_id[: MAX_ID_CHARACTERS - len(tail)].rstrip("-") + tail
        if session.get(CalibrationRow, found) is None:
            return found
    raise AssertionError("numbers do not end")


def add_nominal(
    session: Session,
    device_id: str,
    result: Calibration,
    note: str,
    calibration_id: str,
    profile: CalibratedProfile | None = None,
) -> CalibrationRow:
    """Store a calibration that was not measured; as ``add_calibration``.

    Args:
        session: the session.
        device_id: the device.
        result: the calibration.
        note: its note.
        calibration_id: its id.
        profile: the profile whose geometry it is of; None: the built-in simulator's.
    """
    content = calibration_content(device_id, "nominal", [], result)
    if profile is not None:
        content["profile"] = profile.model_dump(mode="json")
    errors = ControlPointErrors(fitted=None, leave_one_out=None)
    record = CalibrationRecord(result, content, errors.model_dump(mode="json"))
    return add_calibration(session, device_id, record, note, calibration_id)


def activate(session: Session, calibration_id: str) -> CalibrationRow:
    """Point the device to this calibration, without a table, and write the move down.

    Activating what is active already changes nothing and writes nothing, and keeps its table.

    Raises:
        UnknownCalibration, CalibrationRetired.
    """
    row = usable(session, calibration_id)
    if active_id(session, row.device_id) != row.id:
        move_pointer(session, row.device_id, Target(row.id))
    return row


def usable(session: Session, calibration_id: str) -> CalibrationRow:
    """Return a calibration that is not retired, and lock its device.

    Raises:
        UnknownCalibration, CalibrationRetired.
    """
    row = _locked(session, calibration_id)
    check_not_retired(row)
    return row


def _locked(session: Session, calibration_id: str) -> CalibrationRow:
    row = get_calibration(session, calibration_id)
    lock_device(session, row.device_id)
    session.refresh(row)
    return row


def retire(session: Session, calibration_id: str) -> CalibrationRow:
    """Retire a calibration for good; retiring it again changes nothing.

    Raises:
        UnknownCalibration, CalibrationActive.
    """
    row = _locked(session, calibration_id)
    if active_id(session, row.device_id) == row.id:
        raise CalibrationActive(
            f'calibration "{row.id}" is the active one of device "{row.device_id}"; activate '
            "another one before retiring it",
            calibration_id=row.id,
            device_id=row.device_id,
        )
    if row.retired_at is None:
        row.retired_at = datetime.now(UTC)
        session.flush()
    return row


def delete_calibration(session: Session, calibration_id: str) -> None:
    """Delete a calibration to which nothing refers.

    Raises:
        UnknownCalibration.
        CalibrationInUse: the history or a result refers to it.
    """
    row = _locked(session, calibration_id)
    tables: dict[str, type[Any]] = {
        "activations": ActivationRow,
        "correction tables": CorrectionTableRow,
        "drift checks": DriftCheckRow,
        "quality checks": QualityCheckRow,
        "reconstructions": ReconstructionRow,
    }
    conditions: dict[str, tuple[type[Any], Any]] = {
        kind: (table, table.calibration_id == row.id) for kind, table in tables.items()
    }
    of_parent = CalibrationRow.content["parent"]["id"].as_string() == row.id
    conditions["calibrations"] = (CalibrationRow, of_parent)
    advice = "retire it, or delete what refers to it first"
    refuse_if_referred(session, CalibrationInUse, row, advice, conditions)
    session.delete(row)
    session.flush()


def state_of(session: Session, row: CalibrationRow) -> State:
    """Return the calibration's state."""
    if row.retired_at is not None:
        return "retired"
    return "active" if active_id(session, row.device_id) == row.id else "available"


def summary(session: Session, row: CalibrationRow) -> CalibrationSummary:
    """Return the calibration without its numbers."""
    profile = row.content.get("profile")
    return from_attributes(
        CalibrationSummary,
        row,
        state=state_of(session, row),
        profile=None if profile is None else CalibratedProfile.model_validate(profile),
    )


def document(session: Session, row: CalibrationRow) -> dict[str, Any]:
    """Return the calibration, whole, as the JSON object of a CalibrationDocument.

    The members that are hashed are as they were stored: what an earlier version stored has no
    members that came later, and they would not be in its hash.
    """
    shown = summary(session, row).model_dump(mode="json")
    content = {name: value for name, value in row.content.items() if name != "device"}
    return shown | {"parent": None} | content | {"errors": row.errors}


def with_control_points(row: CalibrationRow, sensors: list[Sensor]) -> CalibrationWithControlPoints:
    """Return a calibration of these sensors with the points that it is judged on."""
    points = [ControlPoint.model_validate(point) for point in row.content["points"]]
    held = observations(points, sensors)
    left_out = row.errors["leave_one_out"]
    return CalibrationWithControlPoints(
        result_of(row.content),
        np.array([point.position_mm for point in points], dtype=np.float64).reshape(-1, 3),
        held.readings_px,
        None if left_out is None else optional_rows(left_out["differences_mm"]),
    )
