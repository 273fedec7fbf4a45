"""Resolves the stationary markers of a request: positions or earlier readings."""

from collections.abc import Mapping

import numpy as np
from sqlalchemy.orm import Session

from compute.calibration.result import effective_readings
from compute.errors import InvalidParameter
from service.api.calibrations.calibration_content import observations
from service.api.calibrations.schema import ControlPoint, Reading
from service.api.calibrations.store import with_control_points
from service.api.captures.store import captured_points
from service.api.devices.schema import Sensor
from service.api.drift_checks.schema import (
    StationaryMarker,
    StationaryMarkersRequest,
    StationaryPoint,
)
from service.database.models import CalibrationRow

Earlier = Mapping[str, dict[str, float | Reading]]


def resolve_stationary_markers(
    session: Session,
    calibration: CalibrationRow,
    sensors: list[Sensor],
    given: StationaryMarkersRequest,
) -> list[StationaryMarker]:
    """Return the markers with their reference positions or earlier readings.

    Args:
        session: the session.
        calibration: the calibration in question.
        sensors: its device's.
        given: the request.

    Raises:
        InvalidParameter: neither or both of points and a capture; a marker without position, or
            without earlier readings; an earlier session that is not asked for, or missing.
        UnknownCapture, CaptureOfAnotherDevice, CaptureIncomplete: as they say.
    """
    if (given.earlier_capture_id is None) == (given.against == "capture"):
        state = "missing" if given.earlier_capture_id is None else "given"
        raise InvalidParameter(
            f"earlier_capture_id is {state} against {given.against}; it goes with against capture"
        )
    points = _points(session, calibration.device_id, given)
    if given.against == "positions":
        for point in points:
            if point.position_mm is None:
                raise InvalidParameter(
                    f'point "{point.name}" has no position_mm; against positions every marker '
                    "needs its own, or compare against earlier readings",
                    point=point.name,
                )
        return [_marker(point, None) for point in points]
    if given.earlier_capture_id is not None:
        earlier = _by_name(
            captured_points(
                session, given.earlier_capture_id, calibration.device_id, incomplete=True
            )
        )
        where = f'the earlier session "{given.earlier_capture_id}"'
    else:
        earlier = _of_calibration(calibration, sensors)
        where = f'the control points of calibration "{calibration.id}"'
    for point in points:
        if point.name not in earlier:
            listed = ", ".join(list(earlier)[:20]) or "none"
            raise InvalidParameter(
                f'point "{point.name}" is not among {where}, which are {listed}; leave it out',
                point=point.name,
            )
    return [_marker(point, earlier[point.name]) for point in points]


def _points(
    session: Session, device_id: str, given: StationaryMarkersRequest
) -> list[StationaryPoint]:
    if (given.points is None) == (given.capture_id is None):
        which = "neither" if given.points is None else "both"
        raise InvalidParameter(f"of points and capture_id {which} are given; give one of them")
    if given.points is not None:
        return given.points
    assert given.capture_id is not None
    captured = captured_points(
        session, given.capture_id, device_id, incomplete=given.allow_incomplete
    )
    if not captured:
        raise InvalidParameter(
            f'nothing is captured yet in session "{given.capture_id}"; capture its targets first',
            capture_id=given.capture_id,
        )
    return [
        StationaryPoint(name=point.name, position_mm=point.position_mm, readings=point.readings)
        for point in captured
    ]


def _marker(point: StationaryPoint, earlier: dict[str, float | Reading] | None) -> StationaryMarker:
    return StationaryMarker(
        name=point.name,
        position_mm=point.position_mm,
        readings=point.readings,
        earlier=earlier,
    )


def _by_name(points: list[ControlPoint]) -> Earlier:
    return {point.name: point.readings for point in points}


def _of_calibration(row: CalibrationRow, sensors: list[Sensor]) -> Earlier:
    """Return what the calibration took of its control points, without those it left out."""
    points = [ControlPoint.model_validate(point) for point in row.content["points"]]
    held = with_control_points(row, sensors)
    used, sigma = effective_readings(
        held.calibration, held.readings_px, observations(points, sensors).sigma_px
    )
    assert sigma is not None
    found: dict[str, dict[str, float | Reading]] = {}
    for point, values, deviations in zip(points, used, sigma, strict=True):
        found[point.name] = {
            sensor.name: float(value)
            if np.isnan(deviation)
            else Reading(position_px=float(value), sigma_px=float(deviation))
            for sensor, value, deviation in zip(sensors, values, deviations, strict=True)
            if np.isfinite(value)
        }
    return found
