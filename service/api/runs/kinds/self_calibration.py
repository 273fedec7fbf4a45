"""Self-calibration runs: recordings of targets at unknown positions in, a calibration out."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

from compute.calibration.result import Calibration
from compute.camera.model import SensorModel
from compute.progress import Progress
from service.api.base_models import ResponseModel
from service.api.calibrations.calibration_content import Outcome, calibration_content, result_of
from service.api.calibrations.schema import ControlPointErrors
from service.api.devices.schema import Sensor, check_sensors
from service.api.runs.kinds.calibration import add_outcome
from service.api.runs.self_calibration_schema import NewRecording, recording_of

if TYPE_CHECKING:
    from sqlalchemy.orm import Session

    from service.database.models import CalibrationRow, RunRow


class Request(ResponseModel):
    """What a run keeps of its request."""

    start: str
    recordings: list[NewRecording]
    sensors: list[Sensor]
    datum: Literal["start", "first-pose"]
    result_id: str | None
    note: str


def request_of(request: Request, start: "CalibrationRow") -> dict[str, Any]:
    """Return the request as it is stored, checked as far as that takes no time.

    Raises:
        LumilineError: what is wrong with the recordings.
    """
    from compute.calibration.self_calibration.recording_checks import check_recordings

    models = result_of(start.content).models
    check_sensors(start.device_id, request.sensors, models)
    recordings = [recording_of(given, list(request.sensors)) for given in request.recordings]
    check_recordings(models, recordings)
    return request.model_dump(mode="json")


def task(session: "Session", row: "RunRow") -> tuple[Callable[..., Any], tuple[Any, ...]]:
    """Return what the run's process calls, with its arguments."""
    from service.api.calibrations.store import get_calibration

    request = Request.model_validate(row.request)
    start = get_calibration(session, request.start)
    return compute, (request, result_of(start.content).models)


def store(session: "Session", row: "RunRow", result: Calibration) -> str:
    """Store the calibration and return its id; raises what ``add_outcome`` does."""
    request = Request.model_validate(row.request)
    content = calibration_content(row.device_id, "self-calibrated", [], result)
    errors = ControlPointErrors(fitted=None, leave_one_out=None)
    outcome = Outcome(result, content, errors.model_dump(mode="json"))
    return add_outcome(session, row, outcome, request.note, request.result_id)


def compute(
    report_progress: Progress, request: Request, start: tuple[SensorModel, ...]
) -> Calibration:
    """Calibrate; raises what ``self_calibrate`` does."""
    from compute.calibration.self_calibration.self_calibrate import self_calibrate

    recordings = [recording_of(given, list(request.sensors)) for given in request.recordings]
    found = self_calibrate(start, recordings, datum=request.datum, progress=report_progress)
    return found.calibration
