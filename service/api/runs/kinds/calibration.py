"""Calibration runs: control points in, a calibration out; the request is checked when posted."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from compute.calibration.settings import CalibrationSettings
from compute.camera.observation_checks import check_control_points
from compute.progress import Progress
from service.api.base_models import ResponseModel
from service.api.calibrations.calibration_content import (
    CalibrationRecord,
    calibration_record,
    control_arrays,
    geometry,
)
from service.api.calibrations.schema import ControlPoint
from service.api.devices.schema import Sensor, check_sensors

if TYPE_CHECKING:
    from sqlalchemy.orm import Session

    from service.database.models import RunRow


class Request(ResponseModel):
    """Stored request of a calibration run."""

    points: list[ControlPoint]
    sensors: list[Sensor]
    settings: CalibrationSettings
    result_id: str | None
    capture_id: str | None
    note: str


def request_of(request: Request) -> dict[str, Any]:
    """Return the request as it is stored, checked as far as that takes no time.

    Raises:
        LumilineError: what is wrong with the points or the settings.
    """
    arrays = control_arrays(request.points, request.sensors)
    check_control_points(arrays[0], arrays[1], geometry(request.sensors), arrays[2])
    return request.model_dump(mode="json")


def task(_session: "Session", row: "RunRow") -> tuple[Callable[..., Any], tuple[Any, ...]]:
    """Return what the run's process calls, with its arguments."""
    return compute, (row.device_id, Request.model_validate(row.request))


def store(session: "Session", row: "RunRow", record: CalibrationRecord) -> str:
    """Store the calibration and return its id; raises what ``add_record`` does."""
    request = Request.model_validate(row.request)
    return add_record(session, row, record, request.note, request.result_id)


def add_record(
    session: "Session", row: "RunRow", record: CalibrationRecord, note: str, result_id: str | None
) -> str:
    """Store the calibration that a run made and return its id.

    Raises:
        SensorsChanged: the device has other sensors meanwhile.
        CalibrationExists: the id was taken meanwhile.
    """
    from service.api.calibrations.store import add_calibration
    from service.api.devices.store import get_device, sensors_of_row

    device = get_device(session, row.device_id, lock=True)
    check_sensors(device.id, sensors_of_row(device), record.result.models)
    return add_calibration(session, device.id, record, note, result_id).id


def compute(report_progress: Progress, device_id: str, request: Request) -> CalibrationRecord:
    """Calibrate; raises what ``calibration_record`` does."""
    return calibration_record(
        report_progress, device_id, request.points, request.sensors, request.settings
    )
