"""An update run's process: a calibration brought up to date by still markers."""

from compute.calibration.calibrate import Progress
from compute.calibration.result import Calibration
from service.api.base_models import ResponseModel
from service.api.devices.sensor import Sensor
from service.api.drift_checks.schema import StationaryMarker
from service.api.drift_checks.stationary_markers import still_set


class Request(ResponseModel):
    """What a run keeps of its request."""

    calibration: str
    markers: list[StationaryMarker]
    device_sensors: list[Sensor]
    position_sigma_mm: float
    sensors: list[str] | None
    allowance: dict[str, float] | None
    result_id: str | None
    capture: str | None
    drift_check: str | None
    note: str


def compute(report_progress: Progress, request: Request, parent: Calibration) -> Calibration:
    """Bring the parent up to date; raises what ``update_calibration`` does."""
    from compute.calibration.drift.calibration_update import update_calibration

    report_progress(0.1, "adjusting")
    still = still_set(request.markers, request.device_sensors, parent, request.position_sigma_mm)
    return update_calibration(parent, still, sensors=request.sensors, allowance=request.allowance)
