"""An update run's process: a calibration brought up to date by still markers."""

from compute.calibration.result import Calibration
from compute.calibration.run import Progress
from service.devices.sensor import Sensor
from service.drift_checks.schema import StillMarker
from service.drift_checks.still_set import still_set
from service.schema import Document


class Request(Document):
    """What a run keeps of its request."""

    calibration: str
    markers: list[StillMarker]
    device_sensors: list[Sensor]
    position_sigma_mm: float
    sensors: list[str] | None
    allowance: dict[str, float] | None
    result_id: str | None
    capture: str | None
    drift_check: str | None
    note: str


def compute(tell: Progress, request: Request, parent: Calibration) -> Calibration:
    """Bring the parent up to date; raises what ``update_calibration`` does."""
    from compute.calibration.update import update_calibration

    tell(0.1, "adjusting")
    still = still_set(request.markers, request.device_sensors, parent, request.position_sigma_mm)
    return update_calibration(parent, still, sensors=request.sensors, allowance=request.allowance)
