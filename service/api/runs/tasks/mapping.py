"""A mapping run's process: from measurements at known places to a correction table."""

from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any, Final

import numpy as np
from pydantic import TypeAdapter

from compute.calibration.calibrate import Progress
from compute.calibration.result import Calibration
from compute.mapping.measurements import MappingMeasurements
from compute.mapping.settings import MappingSettings
from service.api.base_models import ResponseModel
from service.api.calibrations.calibration_content import control_arrays
from service.api.calibrations.schema import ControlPoint
from service.api.correction_tables.table_content import TableContent
from service.api.devices.sensor import Sensor

_SAME_MM: Final = 1e-6


class Request(ResponseModel):
    """What a run keeps of its request."""

    calibration: str
    points: list[ControlPoint]
    sensors: list[Sensor]
    settings: MappingSettings
    point_sigma_mm: float
    result_id: str | None
    capture: str | None
    note: str


def measurements(request: Request) -> MappingMeasurements:
    """Return a request's points as the computation takes them; raises as ``control_arrays``."""
    points, readings, sigma = control_arrays(request.points, request.sensors)
    return MappingMeasurements(points, readings, sigma, request.point_sigma_mm)


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
        "point_sigma_mm": request.point_sigma_mm,
        "points_made_the_calibration": covariance is None,
    }
    return TableContent(
        result.table, device_id, datetime.now(UTC), _json(settings), _json(result.validation)
    )


def _shared(points_mm: np.ndarray, made_from_mm: np.ndarray) -> bool:
    """Tell whether the calibration was made from some of these very points."""
    if not len(made_from_mm):
        return False
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(made_from_mm).query(points_mm)
    return bool(np.any(distance < _SAME_MM))


def _json(value: Any) -> dict[str, Any]:
    found: dict[str, Any] = TypeAdapter(type(value)).dump_python(value, mode="json")
    return found
