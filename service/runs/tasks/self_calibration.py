"""A self-calibration run's process: from recordings at unknown places to a calibration."""

from typing import Literal

from compute.calibration.result import Calibration
from compute.calibration.run import Progress
from compute.camera.model import SensorModel
from service.devices.sensor import Sensor
from service.runs.self_calibration_schema import NewRecording, recording_of
from service.schema import Document


class Request(Document):
    """What a run keeps of its request."""

    start: str
    recordings: list[NewRecording]
    sensors: list[Sensor]
    datum: Literal["start", "first-pose"]
    result_id: str | None
    note: str


def compute(tell: Progress, request: Request, start: tuple[SensorModel, ...]) -> Calibration:
    """Calibrate; raises what ``self_calibrate`` does."""
    from compute.calibration.selfcalibration.run import self_calibrate

    recordings = [recording_of(given, list(request.sensors)) for given in request.recordings]
    found = self_calibrate(start, recordings, datum=request.datum, progress=tell)
    return found.calibration
