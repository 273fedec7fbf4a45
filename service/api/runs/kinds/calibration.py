"""Calibration runs: checked when posted, stored when done."""

from collections.abc import Callable
from typing import Any

from sqlalchemy.orm import Session

from compute.calibration.control_data_checks import check_observations
from service.api.calibrations.calibration_content import Outcome, control_arrays
from service.api.calibrations.observations import geometry
from service.api.calibrations.sensor_check import check_sensors
from service.api.calibrations.store import add_calibration
from service.api.devices.store import get_device, sensors_of_row
from service.api.runs.tasks.calibration import Request, compute
from service.database.models import RunRow


def request_of(request: Request) -> dict[str, Any]:
    """Return the request as it is stored, checked as far as that takes no time.

    Raises:
        LumilineError: what is wrong with the points or the settings.
    """
    arrays = control_arrays(request.points, request.sensors)
    check_observations(arrays[0], arrays[1], geometry(request.sensors), arrays[2])
    return request.model_dump(mode="json")


def task(_session: Session, row: RunRow) -> tuple[Callable[..., Any], tuple[Any, ...]]:
    """Return what the run's process calls, with its arguments."""
    return compute, (row.device_id, Request.model_validate(row.request))


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
