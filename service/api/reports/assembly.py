"""Collects the content of a report: a stored calibration and the one to compare it with."""

import hashlib
import json
from typing import Final

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from service.api.calibrations.calibration_content import (
    observations,
    result_of,
)
from service.api.calibrations.comparison import compare
from service.api.calibrations.schema import ControlPoint, LengthErrors
from service.api.calibrations.store import active_id, get_calibration, with_control_points
from service.api.devices.schema import Sensor, sensors_match
from service.api.devices.store import get_device, sensors_of_row
from service.api.reports.content import ComparedCalibration, Relation, ReportContent
from service.database.models import ActivationRow, CalibrationRow
from service.problems.errors import CalibrationOfAnotherDevice
from service.version import package_version

_FROM: Final[dict[str, str]] = {
    "fitted": "control points",
    "self-calibrated": "subjects at unknown places",
    "updated": "its parent and still markers",
    "nominal": "a design's values",
}


def report_key(session: Session, calibration_id: str, previous_id: str | None = None) -> str:
    """Return a hash of all inputs of a report, without rendering it.

    Takes and raises what ``assemble_report`` does.
    """
    row = get_calibration(session, calibration_id)
    device = get_device(session, row.device_id)
    other = _other(session, row, previous_id)
    parts = [
        package_version(),
        [row.id, row.content_hash, row.note, row.created_at.isoformat()],
        [device.id, device.title, device.sensors],
        [other[0].id, other[0].content_hash, other[1]] if other is not None else None,
    ]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def assemble_report(
    session: Session, calibration_id: str, previous_id: str | None = None
) -> ReportContent:
    """Return the content of a calibration's report.

    Args:
        session: the session.
        calibration_id: the calibration.
        previous_id: with which it is compared; None: with the one that was active before it, or,
            where it never was, with the one that is.

    Raises:
        UnknownCalibration: one of the two is not there.
        CalibrationOfAnotherDevice: the two are of different devices.
    """
    row = get_calibration(session, calibration_id)
    device = get_device(session, row.device_id)
    other = _other(session, row, previous_id)
    points = [ControlPoint.model_validate(point) for point in row.content["points"]]
    sensors = _sensors(row, sensors_of_row(device))
    held = with_control_points(row, sensors)
    observed = observations(points, sensors)
    compared = None
    if other is not None and sensors_match(_sensors(other[0], sensors), sensors):
        found, relation = other
        compared = ComparedCalibration(
            found.id, relation, compare(held, with_control_points(found, sensors))
        )
    provenance = {
        "calibration": row.id,
        "device": f"{device.title} ({device.id})",
        "made": f"{row.created_at:%Y-%m-%d %H:%M:%S} UTC",
        "from": _FROM[row.provenance] + _parent(row),
        "note": row.note or "none",
        "content hash": row.content_hash,
        "report by": f"Lumiline {package_version()}",
    }
    lengths = row.errors.get("lengths_left_out")
    return ReportContent(
        title=f"Calibration {row.id} of {device.title}",
        calibration=held.calibration,
        names=[point.name for point in points],
        points_mm=held.points_mm,
        readings_px=held.readings_px,
        sigma_px=observed.sigma_px if np.isfinite(observed.sigma_px).any() else None,
        provenance=provenance,
        compared=compared,
        lengths_left_out=None if lengths is None else LengthErrors.model_validate(lengths),
    )


def _sensors(row: CalibrationRow, now: list[Sensor]) -> list[Sensor]:
    """Return the sensors that a calibration is of, which need not be the device's any more."""
    pitches = {sensor.name: sensor.pitch_um for sensor in now}
    return [
        Sensor(model.name, model.pixels, pitches.get(model.name, 1.0))
        for model in result_of(row.content).models
    ]


def _parent(row: CalibrationRow) -> str:
    parent = row.content.get("parent")
    return "" if parent is None else f", parent {parent['id']} ({parent['content_hash']})"


def _other(
    session: Session, row: CalibrationRow, previous_id: str | None
) -> tuple[CalibrationRow, Relation] | None:
    """Return the calibration to compare with and its relation to this one."""
    if previous_id is not None:
        found = get_calibration(session, previous_id)
        if found.device_id != row.device_id:
            raise CalibrationOfAnotherDevice(
                f'calibration "{found.id}" is of device "{found.device_id}", "{row.id}" of '
                f'"{row.device_id}"; compare calibrations of one device',
                calibration_id=found.id,
            )
        return found, "chosen"
    before = session.scalars(
        select(ActivationRow)
        .where(
            ActivationRow.calibration_id == row.id,
            ActivationRow.previous_calibration_id.is_not(None),
            ActivationRow.previous_calibration_id != row.id,
        )
        .order_by(ActivationRow.id)
        .limit(1)
    ).first()
    if before is not None and before.previous_calibration_id is not None:
        return get_calibration(session, before.previous_calibration_id), "before"
    name = active_id(session, row.device_id)
    if name is None or name == row.id:
        return None
    return get_calibration(session, name), "active"
