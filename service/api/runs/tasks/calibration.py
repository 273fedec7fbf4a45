"""A calibration run's process: from control points to a calibration."""

from compute.calibration.calibrate import Progress
from compute.calibration.settings import CalibrationSettings
from service.api.base_models import ResponseModel
from service.api.calibrations.calibration_content import Outcome, calibration_outcome
from service.api.calibrations.schema import ControlPoint
from service.api.devices.sensor import Sensor


class Request(ResponseModel):
    """What a run keeps of its request."""

    points: list[ControlPoint]
    sensors: list[Sensor]
    settings: CalibrationSettings
    result_id: str | None
    capture: str | None
    note: str


def compute(report_progress: Progress, device_id: str, request: Request) -> Outcome:
    """Calibrate; raises what ``calibration_outcome`` does."""
    return calibration_outcome(
        report_progress, device_id, request.points, request.sensors, request.settings
    )
