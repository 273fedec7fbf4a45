"""REST resources that take runs: /api/v1/calibration-runs, /mapping-runs, ..."""

from typing import Annotated, Any

from fastapi import APIRouter, Body
from sqlalchemy.orm import Session
from starlette.status import HTTP_202_ACCEPTED

from compute.errors import (
    DegeneratePoints,
    DuplicatePoint,
    InvalidParameter,
    ReadingOutsideSensor,
    TooFewPoints,
    UnknownSensor,
)
from service.api.calibrations.calibration_content import result_of
from service.api.calibrations.schema import ControlPoint
from service.api.calibrations.sensor_check import check_sensors
from service.api.calibrations.store import check_unused
from service.api.correction_tables import store as tables
from service.api.devices.sensor import Sensor
from service.api.devices.store import sensors_of_row
from service.api.drift_checks.marker_references import resolve_stationary_markers
from service.api.drift_checks.schema import StationaryMarker
from service.api.drift_checks.store import get_drift_check, markers_of
from service.api.json_body import JsonRoute, JsonTypes
from service.api.openapi import problems
from service.api.runs.examples import (
    NEW_CALIBRATION_RUNS,
    NEW_MAPPING_RUNS,
    NEW_SELF_CALIBRATION_RUNS,
    NEW_UPDATE_RUNS,
)
from service.api.runs.kinds import calibration, mapping, self_calibration, update
from service.api.runs.references import resolve_calibration, resolve_points
from service.api.runs.schema import NewCalibrationRun, NewMappingRun, NewUpdateRun, Run
from service.api.runs.self_calibration_schema import NewSelfCalibrationRun
from service.api.runs.submission import SubmissionDep
from service.api.runs.tasks.calibration import Request as CalibrationRequest
from service.api.runs.tasks.mapping import Request as MappingRequest
from service.api.runs.tasks.self_calibration import Request as SelfCalibrationRequest
from service.api.runs.tasks.update import Request as UpdateRequest
from service.database.models import CalibrationRow, DeviceRow
from service.problems.errors import (
    Busy,
    CalibrationExists,
    CalibrationOfAnotherDevice,
    CalibrationRetired,
    CaptureIncomplete,
    CaptureOfAnotherDevice,
    CorrectionTableExists,
    NoActiveCalibration,
    RunExists,
    SensorsChanged,
    UnknownCalibration,
    UnknownCapture,
    UnknownDevice,
    UnknownDriftCheck,
)

router = APIRouter(prefix="/api/v1", tags=["runs"], route_class=JsonRoute)

NewCalibrationRunBody = Annotated[
    NewCalibrationRun, JsonTypes(), Body(openapi_examples=NEW_CALIBRATION_RUNS)
]
NewMappingRunBody = Annotated[NewMappingRun, JsonTypes(), Body(openapi_examples=NEW_MAPPING_RUNS)]
NewUpdateRunBody = Annotated[NewUpdateRun, JsonTypes(), Body(openapi_examples=NEW_UPDATE_RUNS)]
NewSelfCalibrationRunBody = Annotated[
    NewSelfCalibrationRun, JsonTypes(), Body(openapi_examples=NEW_SELF_CALIBRATION_RUNS)
]


@router.post(
    "/calibration-runs",
    operation_id="create-calibration-run",
    summary="Calibrate a device beside the requests",
    status_code=HTTP_202_ACCEPTED,
    responses=problems(
        UnknownDevice,
        UnknownCapture,
        RunExists,
        CalibrationExists,
        CaptureOfAnotherDevice,
        CaptureIncomplete,
        TooFewPoints,
        DegeneratePoints,
        DuplicatePoint,
        UnknownSensor,
        ReadingOutsideSensor,
        InvalidParameter,
        Busy,
    ),
)
def create_calibration_run(request: NewCalibrationRunBody, acceptance: SubmissionDep) -> Run:
    """Calibrate in a process of its own: follow the run at the header `Location`.

    The calibration is stored when it is done, under the run's `result_id`, and not activated.
    """

    def stored(session: Session, device: DeviceRow) -> dict[str, Any]:
        check_unused(session, request.result_id)
        return calibration.request_of(
            CalibrationRequest(
                points=_points(session, request),
                sensors=sensors_of_row(device),
                settings=request.settings(),
                result_id=request.result_id,
                capture=request.capture,
                note=request.note,
            )
        )

    return acceptance.run("calibration", request, stored)


def _points(session: Session, request: NewCalibrationRun | NewMappingRun) -> list[ControlPoint]:
    return resolve_points(
        session,
        request.device,
        request.points,
        request.capture,
        incomplete=request.allow_incomplete,
    )


@router.post(
    "/mapping-runs",
    operation_id="create-mapping-run",
    summary="Map the volume beside the requests",
    status_code=HTTP_202_ACCEPTED,
    responses=problems(
        UnknownDevice,
        UnknownCalibration,
        UnknownCapture,
        RunExists,
        CorrectionTableExists,
        CalibrationOfAnotherDevice,
        CaptureOfAnotherDevice,
        CaptureIncomplete,
        CalibrationRetired,
        NoActiveCalibration,
        SensorsChanged,
        TooFewPoints,
        DegeneratePoints,
        DuplicatePoint,
        UnknownSensor,
        ReadingOutsideSensor,
        InvalidParameter,
        Busy,
    ),
)
def create_mapping_run(request: NewMappingRunBody, acceptance: SubmissionDep) -> Run:
    """Build a correction table in a process of its own: follow the run at the header `Location`.

    The table is stored when it is done, under the run's `result_id`, and not activated.
    """

    def stored(session: Session, device: DeviceRow) -> dict[str, Any]:
        tables.check_unused(session, request.result_id)
        parent = resolve_calibration(session, request.device, request.calibration)
        return mapping.request_of(
            MappingRequest(
                calibration=parent.id,
                points=_points(session, request),
                sensors=sensors_of_row(device),
                settings=request.settings(),
                point_sigma_mm=request.point_sigma_mm,
                result_id=request.result_id,
                capture=request.capture,
                note=request.note,
            ),
            parent,
        )

    return acceptance.run("mapping", request, stored)


@router.post(
    "/self-calibration-runs",
    operation_id="create-self-calibration-run",
    summary="Calibrate a device without known coordinates",
    status_code=HTTP_202_ACCEPTED,
    responses=problems(
        UnknownDevice,
        UnknownCalibration,
        RunExists,
        CalibrationExists,
        CalibrationOfAnotherDevice,
        CalibrationRetired,
        NoActiveCalibration,
        SensorsChanged,
        TooFewPoints,
        DegeneratePoints,
        UnknownSensor,
        ReadingOutsideSensor,
        InvalidParameter,
        Busy,
    ),
)
def create_self_calibration_run(
    request: NewSelfCalibrationRunBody, acceptance: SubmissionDep
) -> Run:
    """Calibrate from a wand, a rigid body or a frame at unknown places, in a process of its own.

    It starts from a calibration that is near; the scale comes from the lengths given. The new
    calibration is stored when it is done, under the run's `result_id`, and not activated.
    """

    def stored(session: Session, device: DeviceRow) -> dict[str, Any]:
        check_unused(session, request.result_id)
        start = resolve_calibration(session, request.device, request.start)
        return self_calibration.request_of(
            SelfCalibrationRequest(
                start=start.id,
                recordings=request.recordings,
                sensors=sensors_of_row(device),
                datum=request.datum,
                result_id=request.result_id,
                note=request.note,
            ),
            start,
        )

    return acceptance.run("self-calibration", request, stored)


@router.post(
    "/update-runs",
    operation_id="create-update-run",
    summary="Bring a calibration up to date by still markers",
    status_code=HTTP_202_ACCEPTED,
    responses=problems(
        UnknownDevice,
        UnknownCalibration,
        UnknownCapture,
        UnknownDriftCheck,
        RunExists,
        CalibrationExists,
        CalibrationOfAnotherDevice,
        CaptureOfAnotherDevice,
        CaptureIncomplete,
        CalibrationRetired,
        NoActiveCalibration,
        SensorsChanged,
        TooFewPoints,
        DuplicatePoint,
        UnknownSensor,
        ReadingOutsideSensor,
        InvalidParameter,
        Busy,
    ),
)
def create_update_run(request: NewUpdateRunBody, acceptance: SubmissionDep) -> Run:
    """Re-calibrate quickly: what a few still markers say has changed, and the rest as it was.

    Eight markers do where a whole frame was measured before. The new calibration names its parent;
    it is stored when it is done, under the run's `result_id`, and not activated.
    """

    def stored(session: Session, device: DeviceRow) -> dict[str, Any]:
        check_unused(session, request.result_id)
        sensors = sensors_of_row(device)
        parent, markers, sigma = _still(session, request, sensors)
        return update.request_of(
            UpdateRequest(
                calibration=parent.id,
                markers=markers,
                device_sensors=sensors,
                position_sigma_mm=sigma,
                sensors=request.sensors,
                allowance=request.allowance,
                result_id=request.result_id,
                capture=request.capture,
                drift_check=request.drift_check,
                note=request.note,
            ),
            parent,
        )

    return acceptance.run("update", request, stored)


def _still(
    session: Session, request: NewUpdateRun, sensors: list[Sensor]
) -> tuple[CalibrationRow, list[StationaryMarker], float]:
    """Return the parent, the markers and the deviation of their positions [mm]."""
    if request.drift_check is None:
        parent = resolve_calibration(session, request.device, request.calibration)
        check_sensors(parent.device_id, sensors, result_of(parent.content).models)
        return (
            parent,
            resolve_stationary_markers(session, parent, sensors, request),
            request.position_sigma_mm,
        )
    other = {"points", "capture", "earlier_capture", "against", "position_sigma_mm"}
    given = sorted(other & request.model_fields_set)
    if given:
        raise InvalidParameter(
            f"{given[0]} is given with drift_check, which has its own markers; give one of them"
        )
    check = get_drift_check(session, request.drift_check)
    if request.calibration not in (None, check.calibration_id):
        raise InvalidParameter(
            f'drift check "{check.id}" is of calibration "{check.calibration_id}", not of '
            f'"{request.calibration}"; post its markers to compare them with another',
            drift_check=check.id,
            calibration=check.calibration_id,
        )
    parent = resolve_calibration(session, request.device, check.calibration_id)
    return parent, markers_of(check), float(check.given["position_sigma_mm"])
