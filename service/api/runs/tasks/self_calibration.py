"""A self-calibration run's process: from recordings at unknown places to a calibration."""

from typing import Literal

from compute.calibration.calibrate import Progress
from compute.calibration.result import Calibration
from compute.camera.model import SensorModel
from service.api.base_models import ResponseModel
from service.api.devices.sensor import Sensor
from service.api.runs.self_calibration_schema import NewRecording, recording_of


class Request(ResponseModel):
    """What a run keeps of its request."""

    start: str
    recordings: list[NewRecording]
    sensors: list[Sensor]
    datum: Literal["start", "first-pose"]
    result_id: str | None
    note: str


def compute(
    report_progress: Progress, request: Request, start: tuple[SensorModel, ...]
) -> Calibration:
    """Calibrate; raises what ``self_calibrate`` does."""
    from compute.calibration.self_calibration.self_calibrate import self_calibrate

    recordings = [recording_of(given, list(request.sensors)) for given in request.recordings]
    found = self_calibrate(start, recordings, datum=request.datum, progress=report_progress)
    return found.calibration
