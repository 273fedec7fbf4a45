"""Mapping runs: a correction table from measurements at known places, for one calibration."""

from collections.abc import Callable
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any, Final

import numpy as np
from pydantic import TypeAdapter
from sqlalchemy.orm import Session

from compute.calibration.result import Calibration
from compute.calibration.run import Progress
from compute.mapping.measurements import MappingMeasurements
from compute.mapping.settings import MappingSettings
from service.calibrations.run import control_arrays, result_of
from service.calibrations.schema import ControlPoint
from service.calibrations.sensors import check_sensors
from service.calibrations.store import get_calibration, usable
from service.correction_tables.content import TableContent
from service.correction_tables.store import add_table
from service.database.models import CalibrationRow, RunRow
from service.devices.schema import Sensor
from service.devices.store import get_device, sensors_of_row
from service.schema import Document

_SAME_MM: Final = 1e-6


class Request(Document):
    """What a run keeps of its request."""

    calibration: str
    points: list[ControlPoint]
    sensors: list[Sensor]
    settings: MappingSettings
    point_sigma_mm: float
    result_id: str | None
    capture: str | None
    note: str


def request_of(request: Request, calibration: CalibrationRow) -> dict[str, Any]:
    """Return the request as it is stored, checked as far as that takes no time.

    Raises:
        LumilineError: what is wrong with the points or the settings.
    """
    from compute.mapping.measurements import check_measurements

    result = result_of(calibration.content)
    check_sensors(calibration.device_id, request.sensors, result.models)
    check_measurements(_measurements(request), result.models)
    return request.model_dump(mode="json")


def _measurements(request: Request) -> MappingMeasurements:
    points, readings, sigma = control_arrays(request.points, request.sensors)
    return MappingMeasurements(points, readings, sigma, request.point_sigma_mm)


def task(session: Session, row: RunRow) -> tuple[Callable[..., Any], tuple[Any, ...]]:
    """Return what the run's process calls, with its arguments."""
    request = Request.model_validate(row.request)
    calibration = get_calibration(session, request.calibration)
    made_from = np.array(
        [point["position_mm"] for point in calibration.content["points"]], dtype=np.float64
    ).reshape(-1, 3)
    return compute, (
        row.device_id, request, result_of(calibration.content), calibration.content_hash, made_from,
    )  # fmt: skip


def compute(
    tell: Progress,
    device_id: str,
    request: Request,
    calibration: Calibration,
    calibration_hash: str,
    made_from_mm: np.ndarray,
) -> TableContent:
    """Build the table; runs in the run's process."""
    from compute.mapping.build import build_table

    measured = _measurements(request)
    covariance = None
    if not _shared(measured.points_mm, made_from_mm):
        covariance = np.array(calibration.covariance)
    result = build_table(
        calibration.models, calibration_hash, measured, covariance, request.settings, tell
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


def store(session: Session, row: RunRow, content: TableContent) -> str:
    """Store the table and return its id.

    Raises:
        SensorsChanged, CalibrationRetired, CorrectionTableExists, TableHasHoles: as they say.
    """
    request = Request.model_validate(row.request)
    calibration = usable(session, request.calibration)
    device = get_device(session, row.device_id)
    check_sensors(device.id, sensors_of_row(device), result_of(calibration.content).models)
    return add_table(session, content, calibration, "run", request.note, request.result_id).id
