"""Mapping runs: measurements at known positions in, a correction table out."""

from collections.abc import Callable
from dataclasses import asdict
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from pydantic import TypeAdapter

from compute.calibration.result import Calibration
from compute.mapping.measurements import MappingMeasurements
from compute.mapping.result import MappingSettings
from compute.progress import Progress
from service.api.base_models import ResponseModel
from service.api.calibrations.calibration_content import control_arrays, result_of
from service.api.calibrations.schema import ControlPoint
from service.api.correction_tables.table_content import TableContent
from service.api.devices.schema import Sensor, check_sensors

if TYPE_CHECKING:
    from sqlalchemy.orm import Session

    from service.database.models import CalibrationRow, RunRow

_SAME_MM: Final = 1e-6


class Request(ResponseModel):
    """Stored request of a mapping run."""

    calibration_id: str
    points: list[ControlPoint]
    sensors: list[Sensor]
    settings: MappingSettings
    position_sigma_mm: float
    result_id: str | None
    capture_id: str | None
    note: str


def request_of(request: Request, calibration: "CalibrationRow") -> dict[str, Any]:
    """Return the request as it is stored, checked as far as that takes no time.

    Raises:
        LumilineError: what is wrong with the points or the settings.
    """
    from compute.mapping.measurements import check_measurements, grid_for_points, point_spacing

    result = result_of(calibration.content)
    check_sensors(calibration.device_id, request.sensors, result.models)
    measured = measurements(request)
    check_measurements(measured, result.models)
    if request.settings.method == "b-spline":
        grid_for_points(measured, point_spacing(measured), request.settings)
    return request.model_dump(mode="json")


def task(session: "Session", row: "RunRow") -> tuple[Callable[..., Any], tuple[Any, ...]]:
    """Return what the run's process calls, with its arguments."""
    from service.api.calibrations.store import get_calibration

    request = Request.model_validate(row.request)
    calibration = get_calibration(session, request.calibration_id)
    made_from = np.array(
        [point["position_mm"] for point in calibration.content["points"]], dtype=np.float64
    ).reshape(-1, 3)
    return compute, (
        row.device_id, request, result_of(calibration.content), calibration.content_hash, made_from,
    )  # fmt: skip


def store(session: "Session", row: "RunRow", content: TableContent) -> str:
    """Store the table and return its id.

    Raises:
        SensorsChanged, CalibrationRetired, CorrectionTableExists, NoValidCells: as they say.
    """
    from service.api.calibrations.store import usable
    from service.api.correction_tables.store import add_table
    from service.api.devices.store import get_device, sensors_of_row

    request = Request.model_validate(row.request)
    calibration = usable(session, request.calibration_id)
    device = get_device(session, row.device_id)
    check_sensors(device.id, sensors_of_row(device), result_of(calibration.content).models)
    return add_table(session, content, calibration, "run", request.note, request.result_id).id


def measurements(request: Request) -> MappingMeasurements:
    """Return a request's points as the computation takes them; raises as ``control_arrays``."""
    points, readings, sigma = control_arrays(request.points, request.sensors)
    return MappingMeasurements(points, readings, sigma, request.position_sigma_mm)


def compute(
    report_progress: Progress,
    device_id: str,
    request: Request,
    calibration: Calibration,
    calibration_hash: str,
    made_from_mm: np.ndarray,
) -> TableContent:
    """Build the table; raises what ``build_table`` does."""
    from compute.mapping.build import build_table

    measured = measurements(request)
    covariance = None
    if not _shared(measured.points_mm, made_from_mm):
        covariance = np.array(calibration.covariance)
    result = build_table(
        calibration.models,
        calibration_hash,
        measured,
        covariance,
        request.settings,
        report_progress,
    )
    settings = asdict(result.settings) | {
        "points": len(request.points),
        "position_sigma_mm": request.position_sigma_mm,
        "points_made_the_calibration": covariance is None,
    }
    return TableContent(
        result.table, device_id, datetime.now(UTC), _json(settings), _json(result.validation)
    )


def _shared(points_mm: np.ndarray, made_from_mm: np.ndarray) -> bool:
    """Return whether any of these points was a control point of the calibration."""
    if not len(made_from_mm):
        return False
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(made_from_mm).query(points_mm)
    return bool(np.any(distance < _SAME_MM))


def _json(value: Any) -> dict[str, Any]:
    found: dict[str, Any] = TypeAdapter(type(value)).dump_python(value, mode="json")
    return found
