"""Mapping runs: checked when posted, stored when done."""

from collections.abc import Callable
from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from service.api.calibrations.calibration_content import result_of
from service.api.calibrations.sensor_check import check_sensors
from service.api.calibrations.store import get_calibration, usable
from service.api.correction_tables.store import add_table
from service.api.correction_tables.table_content import TableContent
from service.api.devices.store import get_device, sensors_of_row
from service.api.runs.tasks.mapping import Request, compute, measurements
from service.database.models import CalibrationRow, RunRow


def request_of(request: Request, calibration: CalibrationRow) -> dict[str, Any]:
    """Return the request as it is stored, checked as far as that takes no time.

    Raises:
        LumilineError: what is wrong with the points or the settings.
    """
    from compute.mapping.grid_extent import grid_for_points, point_spacing
    from compute.mapping.measurements import check_measurements

    result = result_of(calibration.content)
    check_sensors(calibration.device_id, request.sensors, result.models)
    measured = measurements(request)
    check_measurements(measured, result.models)
    if request.settings.method == "b-spline":
        grid_for_points(measured, point_spacing(measured), request.settings)
    return request.model_dump(mode="json")


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
