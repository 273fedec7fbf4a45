"""What requests name: control points or the capture that holds them, a calibration or none."""

from sqlalchemy.orm import Session

from compute.errors import InvalidParameter
from service.api.calibrations.schema import ControlPoint
from service.api.calibrations.store import active_id, usable
from service.api.captures.store import captured_points
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
        raise InvalidParameter(f"of points and capture {given} are given; give one of them")
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
            device=device_id,
        )
    row = usable(session, name)
    if row.device_id != device_id:
        raise CalibrationOfAnotherDevice(
            f'calibration "{row.id}" is of device "{row.device_id}"; the measurements are of '
            f'"{device_id}"',
            calibration=row.id,
            device=device_id,
        )
    return row
