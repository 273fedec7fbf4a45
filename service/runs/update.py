"""Update runs: checked when posted; a new calibration that names its parent when done."""

from collections.abc import Callable
from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from compute.calibration.crossvalidation import fitted_errors
from compute.calibration.effective_readings import count_readings
from compute.calibration.result import Calibration
from compute.calibration.still_set import compare
from compute.calibration.update import check_update
from service.calibrations.run import Outcome, calibration_content, point_errors, result_of
from service.calibrations.schema import ControlPoint, ControlPointErrors
from service.calibrations.sensors import check_sensors
from service.calibrations.store import add_calibration, get_calibration
from service.database.models import CalibrationRow, RunRow
from service.devices.store import get_device, sensors_of_row
from service.drift_checks.still_set import still_set
from service.runs.tasks.update import Request, compute


def request_of(request: Request, parent: CalibrationRow) -> dict[str, Any]:
    """Return the request as it is stored, checked as far as that takes no time.

    Raises:
        LumilineError: what is wrong with the markers or the settings.
    """
    result = result_of(parent.content)
    check_sensors(parent.device_id, request.device_sensors, result.models)
    still = still_set(request.markers, request.device_sensors, result, request.position_sigma_mm)
    check_update(result, sensors=request.sensors, allowance=request.allowance)
    compare(result, still)
    return request.model_dump(mode="json")


def task(session: Session, row: RunRow) -> tuple[Callable[..., Any], tuple[Any, ...]]:
    """Return what the run's process calls, with its arguments."""
    request = Request.model_validate(row.request)
    return compute, (request, result_of(get_calibration(session, request.calibration).content))


def store(session: Session, row: RunRow, result: Calibration) -> str:
    """Store the calibration and return its id.

    Raises:
        SensorsChanged: the device has other sensors meanwhile.
        CalibrationExists: the id was taken meanwhile.
    """
    request = Request.model_validate(row.request)
    parent = get_calibration(session, request.calibration)
    device = get_device(session, row.device_id, lock=True)
    check_sensors(device.id, sensors_of_row(device), result.models)
    points, errors = _judged(request, result)
    content = calibration_content(device.id, "updated", points, result) | {
        "parent": {"id": parent.id, "content_hash": parent.content_hash}
    }
    outcome = Outcome(result, content, errors.model_dump(mode="json"))
    return add_calibration(session, device.id, outcome, request.note, request.result_id).id


def _judged(request: Request, result: Calibration) -> tuple[list[ControlPoint], ControlPointErrors]:
    """Return the markers as control points where their positions are known, and their errors."""
    none = ControlPointErrors(fitted=None, leave_one_out=None)
    if request.markers[0].earlier is not None:
        return [], none
    points = [
        ControlPoint.model_validate(marker.model_dump(include={"name", "position_mm", "readings"}))
        for marker in request.markers
    ]
    still = still_set(request.markers, request.device_sensors, result, request.position_sigma_mm)
    assert still.places_mm is not None
    differences = fitted_errors(result, still.places_mm, still.readings_px, still.sigma_px)
    seen = count_readings(still.readings_px, differences)
    if not np.isfinite(differences).any():
        return points, none
    return points, ControlPointErrors(fitted=point_errors(differences, seen), leave_one_out=None)
