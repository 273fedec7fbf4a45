"""Calibration runs: checked when posted, computed in the run's process, stored when done."""

from collections.abc import Callable, Sequence
from typing import Any

from sqlalchemy.orm import Session

from compute.calibration.checks import check_observations
from compute.calibration.run import Progress
from compute.calibration.settings import CalibrationSettings
from hardware.driver import SensorDescription
from service.calibrations.observations import geometry
from service.calibrations.run import Outcome, calibration_outcome, control_arrays
from service.calibrations.schema import ControlPoint
from service.calibrations.sensors import check_sensors
from service.calibrations.store import add_calibration
from service.database.models import RunRow
from service.devices.schema import Sensor
from service.devices.store import get_device, sensors_of_row
from service.schema import Document


class Request(Document):
    """What a run keeps of its request."""

    points: list[ControlPoint]
    sensors: list[Sensor]
    settings: CalibrationSettings
    result_id: str | None
    capture: str | None
    note: str


def request_of(
    points: list[ControlPoint],
    sensors: list[Sensor],
    settings: CalibrationSettings,
    *,
    result_id: str | None,
    capture: str | None,
    note: str,
) -> dict[str, Any]:
    """Return the request as it is stored, checked as far as that takes no time.

    Raises:
        LumilineError: what is wrong with the points or the settings.
    """
    arrays = control_arrays(points, sensors)
    check_observations(arrays[0], arrays[1], geometry(sensors), arrays[2])
    request = Request(
        points=points,
        sensors=sensors,
        settings=settings,
        result_id=result_id,
        capture=capture,
        note=note,
    )
    return request.model_dump(mode="json")


def task(_session: Session, row: RunRow) -> tuple[Callable[..., Any], tuple[Any, ...]]:
    """Return what the run's process calls, with its arguments."""
    request = Request.model_validate(row.request)
    return compute, (row.device_id, request.points, request.sensors, request.settings)


def compute(
    tell: Progress,
    device_id: str,
    points: list[ControlPoint],
    sensors: Sequence[SensorDescription],
    settings: CalibrationSettings,
) -> Outcome:
    """Calibrate; runs in the run's process."""
    return calibration_outcome(tell, device_id, points, sensors, settings)


def store(session: Session, row: RunRow, outcome: Outcome) -> str:
    """Store the calibration and return its id.

    Raises:
        SensorsChanged: the device has other sensors meanwhile.
        CalibrationExists: the id was taken meanwhile.
    """
    request = Request.model_validate(row.request)
    device = get_device(session, row.device_id, lock=True)
    check_sensors(device.id, sensors_of_row(device), outcome.result.models)
    made = add_calibration(session, row.device_id, outcome, request.note, request.result_id)
    return made.id
