"""Update runs: readings of stationary markers in, an adjusted calibration out."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from compute.calibration.assessment.assess import fitted_errors
from compute.calibration.drift.calibration_update import check_update
from compute.calibration.drift.stability_check import prediction_residuals
from compute.calibration.result import Calibration, count_readings
from compute.progress import Progress
from service.api.base_models import ResponseModel
from service.api.calibrations.calibration_content import (
    CalibrationRecord,
    calibration_content,
    point_errors,
    result_of,
)
from service.api.calibrations.schema import ControlPoint, ControlPointErrors
from service.api.devices.schema import Sensor, check_sensors
from service.api.drift_checks.schema import StationaryMarker
from service.api.drift_checks.stationary_markers import marker_arrays
from service.api.runs.kinds.calibration import add_record

if TYPE_CHECKING:
    from sqlalchemy.orm import Session

    from service.database.models import CalibrationRow, RunRow


class Request(ResponseModel):
    """Stored request of an update run."""

    calibration_id: str
    markers: list[StationaryMarker]
    device_sensors: list[Sensor]
    position_sigma_mm: float
    sensors: list[str] | None
    allowance: dict[str, float] | None
    result_id: str | None
    capture_id: str | None
    drift_check_id: str | None
    note: str


def request_of(request: Request, parent: "CalibrationRow") -> dict[str, Any]:
    """Return the request as it is stored, checked as far as that takes no time.

    Raises:
        LumilineError: what is wrong with the markers or the settings.
    """
    result = result_of(parent.content)
    check_sensors(parent.device_id, request.device_sensors, result.models)
    still = marker_arrays(
        request.markers, request.device_sensors, result, request.position_sigma_mm
    )
    check_update(result, sensors=request.sensors, allowance=request.allowance)
    prediction_residuals(result, still)
    return request.model_dump(mode="json")


def task(session: "Session", row: "RunRow") -> tuple[Callable[..., Any], tuple[Any, ...]]:
    """Return what the run's process calls, with its arguments."""
    from service.api.calibrations.store import get_calibration

    request = Request.model_validate(row.request)
    return compute, (request, result_of(get_calibration(session, request.calibration_id).content))


def store(session: "Session", row: "RunRow", result: Calibration) -> str:
    """Store the calibration and return its id; raises what ``add_record`` does."""
    from service.api.calibrations.store import get_calibration

    request = Request.model_validate(row.request)
    parent = get_calibration(session, request.calibration_id)
    points, errors = _drift_verdict(request, result)
    content = calibration_content(row.device_id, "updated", points, result) | {
        "parent": {"id": parent.id, "content_hash": parent.content_hash}
    }
    record = CalibrationRecord(result, content, errors.model_dump(mode="json"))
    return add_record(session, row, record, request.note, request.result_id)


def _drift_verdict(
    request: Request, result: Calibration
) -> tuple[list[ControlPoint], ControlPointErrors]:
    """Return the markers as control points where their positions are known, and their errors."""
    none = ControlPointErrors(fitted=None, leave_one_out=None)
    if request.markers[0].earlier is not None:
        return [], none
    points = [
        ControlPoint.model_validate(marker.model_dump(include={"name", "position_mm", "readings"}))
        for marker in request.markers
    ]
    still = marker_arrays(
        request.markers, request.device_sensors, result, request.position_sigma_mm
    )
    assert still.positions_mm is not None
    differences = fitted_errors(result, still.positions_mm, still.readings_px, still.sigma_px)
    seen = count_readings(still.readings_px, differences)
    if not np.isfinite(differences).any():
        return points, none
    return points, ControlPointErrors(fitted=point_errors(differences, seen), leave_one_out=None)


def compute(report_progress: Progress, request: Request, parent: Calibration) -> Calibration:
    """Bring the parent up to date; raises what ``update_calibration`` does."""
    from compute.calibration.drift.calibration_update import update_calibration

    report_progress(0.1, "adjusting")
    still = marker_arrays(
        request.markers, request.device_sensors, parent, request.position_sigma_mm
    )
    return update_calibration(parent, still, sensors=request.sensors, allowance=request.allowance)
