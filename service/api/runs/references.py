"""Resolves what run requests refer to: captures, calibrations, drift checks."""

from sqlalchemy.orm import Session

from compute.errors import InvalidParameter
from service.api.calibrations.calibration_content import result_of
from service.api.calibrations.schema import ControlPoint
from service.api.calibrations.store import active_id, usable
from service.api.captures.store import captured_points
from service.api.devices.schema import Sensor, check_sensors
from service.api.drift_checks.marker_references import resolve_stationary_markers
from service.api.drift_checks.schema import StationaryMarker
from service.api.drift_checks.store import DRIFT_CHECKS, markers_of
from service.api.runs.kinds.self_calibration_schema import (
    NewRecording,
    NewSelfCalibrationRun,
    recording_of_wave,
)
from service.api.runs.schema import NewUpdateRun
from service.api.wave_captures.store import captured_recording
from service.database.models import CalibrationRow
from service.problems.errors import CalibrationOfAnotherDevice, NoActiveCalibration


def resolve_points(
    session: Session,
    device_id: str,
    points: list[ControlPoint] | None,
    capture: str | None,
    *,
    incomplete: bool,
) -> list[ControlPoint]:
    """Return the control points that a request gives, or the capture session that it names.

    Raises:
        InvalidParameter: neither or both are given.
        UnknownCapture, CaptureOfAnotherDevice, CaptureIncomplete: as they say.
    """
    if (points is None) == (capture is None):
        given = "neither" if points is None else "both"
        raise InvalidParameter(f"of points and capture_id {given} are given; give one of them")
    if points is not None:
        return points
    assert capture is not None
    return captured_points(session, capture, device_id, incomplete=incomplete)


def resolve_calibration(session: Session, device_id: str, named: str | None) -> CalibrationRow:
    """Return the calibration that a request names, or its device's active one.

    Raises:
        NoActiveCalibration, UnknownCalibration, CalibrationRetired: as they say.
        CalibrationOfAnotherDevice: it is not of this device.
    """
    name = named or active_id(session, device_id)
    if name is None:
        raise NoActiveCalibration(
            f'device "{device_id}" has no active calibration; activate one, or name one '
            "in the request",
            device_id=device_id,
        )
    row = usable(session, name)
    if row.device_id != device_id:
        raise CalibrationOfAnotherDevice(
            f'calibration "{row.id}" is of device "{row.device_id}"; the measurements are of '
            f'"{device_id}"',
            calibration_id=row.id,
            device_id=device_id,
        )
    return row


def resolve_recordings(
    session: Session, request: NewSelfCalibrationRun, sensors: list[Sensor]
) -> list[NewRecording]:
    """Return the recordings of a self-calibration, given or of a wave capture.

    Raises:
        InvalidParameter: both or neither are given.
        UnknownWaveCapture, CaptureOfAnotherDevice, CaptureIncomplete: as they say.
    """
    if (request.recordings is None) == (request.wave_capture_id is None):
        raise InvalidParameter(
            "give recordings or wave_capture_id: what the sensors read of the wand, or the session "
            "in which the server took it; not both"
        )
    if request.recordings is not None:
        return request.recordings
    assert request.wave_capture_id is not None
    target, taken = captured_recording(session, request.wave_capture_id, request.device_id)
    return [recording_of_wave(target, taken, sensors)]


def resolve_markers(
    session: Session, request: NewUpdateRun, sensors: list[Sensor]
) -> tuple[CalibrationRow, list[StationaryMarker], float]:
    """Return the calibration to update, its markers and the sigma of their positions [mm].

    Raises:
        InvalidParameter: the drift check is of another calibration, or markers are given beside it.
        LumilineError: what is wrong with the markers.
    """
    if request.drift_check_id is None:
        parent = resolve_calibration(session, request.device_id, request.calibration_id)
        check_sensors(parent.device_id, sensors, result_of(parent.content).models)
        return (
            parent,
            resolve_stationary_markers(session, parent, sensors, request),
            request.position_sigma_mm,
        )
    other = {"points", "capture_id", "earlier_capture_id", "against", "position_sigma_mm"}
    given = sorted(other & request.model_fields_set)
    if given:
        raise InvalidParameter(
            f"{given[0]} is given with drift_check_id, which has its own markers; give one of them"
        )
    check = DRIFT_CHECKS.get(session, request.drift_check_id)
    if request.calibration_id not in (None, check.calibration_id):
        raise InvalidParameter(
            f'drift check "{check.id}" is of calibration "{check.calibration_id}", not of '
            f'"{request.calibration_id}"; post its markers to compare them with another',
            drift_check_id=check.id,
            calibration_id=check.calibration_id,
        )
    parent = resolve_calibration(session, request.device_id, check.calibration_id)
    return parent, markers_of(check), float(check.given["position_sigma_mm"])
