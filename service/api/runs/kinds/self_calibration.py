"""Self-calibration runs: recordings of targets at unknown positions in, a calibration out."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

from compute.calibration.result import Calibration
from compute.camera.model import SensorGeometry, SensorModel
from compute.errors import InvalidParameter
from compute.progress import Progress
from service.api.base_models import ResponseModel
from service.api.calibrations.calibration_content import (
    CalibrationRecord,
    calibration_content,
    result_of,
)
from service.api.calibrations.schema import ControlPointErrors, GivenDistortion, LengthErrors
from service.api.devices.schema import Sensor, check_sensors
from service.api.runs.kinds.calibration import add_record
from service.api.runs.kinds.self_calibration_schema import (
    NewRecording,
    directions_of,
    recording_of,
)

if TYPE_CHECKING:
    from sqlalchemy.orm import Session

    from service.database.models import CalibrationRow, RunRow


_CALIBRATION_SHARE: Final = 0.8
"""Share of the run's time until the cameras are there; the rest checks them."""


@dataclass(frozen=True)
class SelfCalibrated:
    """Result of a self-calibration run's process."""

    calibration: Calibration
    lengths_left_out: LengthErrors | None


class Request(ResponseModel):
    """Stored request of a self-calibration run."""

    start_calibration_id: str | None
    initial: Literal["start", "readings"] = "start"
    directions_deg: dict[str, float] | None = None
    distortion: GivenDistortion = "none"
    recordings: list[NewRecording]
    wave_capture_id: str | None = None
    sensors: list[Sensor]
    datum: Literal["start", "first-pose"]
    result_id: str | None
    note: str


def request_of(request: Request, start: "CalibrationRow | None") -> dict[str, Any]:
    """Return the request as it is stored, checked as far as that takes no time.

    Raises:
        LumilineError: what is wrong with the recordings.
    """
    from compute.calibration.self_calibration.recording_checks import check_recordings
    from compute.calibration.self_calibration.uncalibrated_start import check_uncalibrated

    given = None if start is None else result_of(start.content).models
    if start is not None and given is not None:
        check_sensors(start.device_id, request.sensors, given)
    models = _initial(request, given)
    directions_of(request.directions_deg, list(request.sensors))
    if start is not None and (request.directions_deg is not None or request.distortion != "none"):
        raise InvalidParameter(
            "directions_deg and distortion are for a run without a start, which has both; leave "
            "them out, or give initial as readings without a start"
        )
    recordings = [recording_of(given, list(request.sensors)) for given in request.recordings]
    check_recordings(models, recordings)
    if request.initial == "readings":
        check_uncalibrated(len(models), recordings)
    return request.model_dump(mode="json")


def task(session: "Session", row: "RunRow") -> tuple[Callable[..., Any], tuple[Any, ...]]:
    """Return what the run's process calls, with its arguments."""
    from service.api.calibrations.store import get_calibration

    request = Request.model_validate(row.request)
    start = (
        None
        if request.start_calibration_id is None
        else get_calibration(session, request.start_calibration_id)
    )
    return compute, (request, None if start is None else result_of(start.content).models)


def store(session: "Session", row: "RunRow", made: "SelfCalibrated") -> str:
    """Store the calibration and return its id; raises what ``add_record`` does."""
    request = Request.model_validate(row.request)
    result = made.calibration
    content = calibration_content(row.device_id, "self-calibrated", [], result)
    errors = ControlPointErrors(
        fitted=None, leave_one_out=None, lengths_left_out=made.lengths_left_out
    )
    record = CalibrationRecord(result, content, errors.model_dump(mode="json"))
    remarks = () if result.diagnosis is None else result.diagnosis.remarks
    note = "\n".join([*filter(None, [request.note]), *(f"WARNING: {one}" for one in remarks)])
    return add_record(session, row, record, note, request.result_id)


def compute(
    report_progress: Progress, request: Request, start: tuple[SensorModel, ...] | None
) -> "SelfCalibrated":
    """Calibrate, and measure lengths at poses held out; raises what ``self_calibrate`` does."""
    from compute.calibration.self_calibration.held_out_lengths import held_out_lengths
    from compute.calibration.self_calibration.self_calibrate import self_calibrate

    recordings = [recording_of(given, list(request.sensors)) for given in request.recordings]
    found = self_calibrate(
        _initial(request, start),
        recordings,
        initial=request.initial,
        directions_deg=directions_of(request.directions_deg, list(request.sensors)),
        distortion=request.distortion,
        datum=request.datum,
        progress=lambda share, stage: report_progress(_CALIBRATION_SHARE * share, stage),
    )
    held_out = held_out_lengths(
        found,
        recordings,
        lambda share, stage: report_progress(
            _CALIBRATION_SHARE + (1.0 - _CALIBRATION_SHARE) * share, stage
        ),
    )
    return SelfCalibrated(
        found.calibration, None if held_out is None else LengthErrors(**asdict(held_out))
    )


def _initial(
    request: Request, start: tuple[SensorModel, ...] | None
) -> tuple[SensorModel, ...] | tuple[SensorGeometry, ...]:
    if start is not None:
        return start
    return tuple(SensorGeometry(sensor.name, sensor.pixels) for sensor in request.sensors)
