"""A calibration run's process: from control points to a calibration."""

from compute.calibration.run import Progress
from compute.calibration.settings import CalibrationSettings
from service.calibrations.run import Outcome, calibration_outcome
from service.calibrations.schema import ControlPoint
from service.devices.sensor import Sensor
from service.schema import Document


class Request(Document):
    """What a run keeps of its request."""

    points: list[ControlPoint]
    sensors: list[Sensor]
    settings: CalibrationSettings
    result_id: str | None
    capture: str | None
    note: str


def compute(tell: Progress, device_id: str, request: Request) -> Outcome:
    """Calibrate; raises what ``calibration_outcome`` does."""
    return calibration_outcome(tell, device_id, request.points, request.sensors, request.settings)
