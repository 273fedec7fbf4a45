"""REST resources /api/v1/calibration-runs, /api/v1/mapping-runs and /api/v1/runs."""

from typing import Annotated

from fastapi import APIRouter, Body, Path, Query, Response
from sqlalchemy.orm import Session
from starlette.status import HTTP_202_ACCEPTED, HTTP_204_NO_CONTENT

from compute.errors import (
    DegeneratePoints,
    DuplicatePoint,
    InvalidParameter,
    ReadingOutsideSensor,
    TooFewPoints,
    UnknownSensor,
)
from service.calibrations.schema import ControlPoint
from service.calibrations.store import active_id, check_unused, usable
from service.captures.store import captured_points
from service.correction_tables import store as tables
from service.database.models import CalibrationRow
from service.dependencies import DatabaseDep, RunsDep, SettingsDep
from service.devices.store import get_device, sensors_of_row
from service.errors import (
    Busy,
    CalibrationExists,
    CalibrationOfAnotherDevice,
    CalibrationRetired,
    CaptureIncomplete,
    CaptureOfAnotherDevice,
    CorrectionTableExists,
    NoActiveCalibration,
    RunExists,
    RunNotEnded,
    SensorsChanged,
    UnknownCalibration,
    UnknownCapture,
    UnknownDevice,
    UnknownRun,
)
from service.json_body import FromJson, JsonRoute
from service.openapi import problems
from service.runs import calibration, mapping, self_calibration, store
from service.runs.document import run_document
from service.runs.examples import (
    NEW_CALIBRATION_RUNS,
    NEW_MAPPING_RUNS,
    NEW_SELF_CALIBRATION_RUNS,
)
from service.runs.schema import NewCalibrationRun, NewMappingRun, Run
from service.runs.self_calibration_schema import NewSelfCalibrationRun
from service.runs.store import Kind, State
from service.schema import SLUG_PATTERN, DeviceFilter, Limit, Offset, Page

router = APIRouter(prefix="/api/v1", tags=["runs"], route_class=JsonRoute)

NewCalibrationRunBody = Annotated[
    NewCalibrationRun, FromJson(), Body(openapi_examples=NEW_CALIBRATION_RUNS)
]
NewMappingRunBody = Annotated[NewMappingRun, FromJson(), Body(openapi_examples=NEW_MAPPING_RUNS)]
NewSelfCalibrationRunBody = Annotated[
    NewSelfCalibrationRun, FromJson(), Body(openapi_examples=NEW_SELF_CALIBRATION_RUNS)
]
RunPath = Annotated[
    str,
    Path(
        pattern=SLUG_PATTERN,
        description="The run's id.",
        openapi_examples={"frame": {"summary": "of the example body", "value": "sim-frame-run"}},
    ),
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
def create_calibration_run(
    request: NewCalibrationRunBody,
    database: DatabaseDep,
    runs: RunsDep,
    settings: SettingsDep,
    response: Response,
) -> Run:
    """Calibrate in a process of its own: follow the run at the header `Location`.

    The calibration is stored when it is done, under the run's `result_id`, and not activated.
    """
    with database.write() as session:
        device = get_device(session, request.device, lock=True)
        check_unused(session, request.result_id)
        stored = calibration.request_of(
            _points(session, request),
            sensors_of_row(device),
            request.settings(),
            result_id=request.result_id,
            capture=request.capture,
            note=request.note,
        )
        row = store.add_run(
            session, "calibration", device.id, stored, settings.runs_waiting, request.id
        )
        made = run_document(row)
    runs.submitted()
    response.headers["Location"] = f"/api/v1/runs/{made.id}"
    return made


def _points(session: Session, request: NewCalibrationRun | NewMappingRun) -> list[ControlPoint]:
    """Return the control points that a request gives, or the capture session that it names.

    Raises:
        InvalidParameter: neither or both are given.
        UnknownCapture, CaptureOfAnotherDevice, CaptureIncomplete: as they say.
    """
    if (request.points is None) == (request.capture is None):
        given = "neither" if request.points is None else "both"
        raise InvalidParameter(f"of points and capture {given} are given; give one of them")
    if request.points is not None:
        return request.points
    assert request.capture is not None
    return captured_points(
        session, request.capture, request.device, incomplete=request.allow_incomplete
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
def create_mapping_run(
    request: NewMappingRunBody,
    database: DatabaseDep,
    runs: RunsDep,
    settings: SettingsDep,
    response: Response,
) -> Run:
    """Build a correction table in a process of its own: follow the run at the header `Location`.

    The table is stored when it is done, under the run's `result_id`, and not activated.
    """
    with database.write() as session:
        device = get_device(session, request.device, lock=True)
        tables.check_unused(session, request.result_id)
        parent = _named_or_active(session, request.device, request.calibration)
        stored = mapping.request_of(
            mapping.Request(
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
        row = store.add_run(
            session, "mapping", device.id, stored, settings.runs_waiting, request.id
        )
        made = run_document(row)
    runs.submitted()
    response.headers["Location"] = f"/api/v1/runs/{made.id}"
    return made


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
    request: NewSelfCalibrationRunBody,
    database: DatabaseDep,
    runs: RunsDep,
    settings: SettingsDep,
    response: Response,
) -> Run:
    """Calibrate from a wand, a rigid body or a frame at unknown places, in a process of its own.

    It starts from a calibration that is near; the scale comes from the lengths given. The new
    calibration is stored when it is done, under the run's `result_id`, and not activated.
    """
    with database.write() as session:
        device = get_device(session, request.device, lock=True)
        check_unused(session, request.result_id)
        start = _named_or_active(session, request.device, request.start)
        stored = self_calibration.request_of(
            self_calibration.Request(
                start=start.id,
                recordings=request.recordings,
                sensors=sensors_of_row(device),
                datum=request.datum,
                result_id=request.result_id,
                note=request.note,
            ),
            start,
        )
        row = store.add_run(
            session, "self-calibration", device.id, stored, settings.runs_waiting, request.id
        )
        made = run_document(row)
    runs.submitted()
    response.headers["Location"] = f"/api/v1/runs/{made.id}"
    return made


def _named_or_active(session: Session, device_id: str, named: str | None) -> CalibrationRow:
    name = named or active_id(session, device_id)
    if name is None:
        raise NoActiveCalibration(
            f'device "{device_id}" has no active calibration; activate one, or name one '
            "in the request",
            device=device_id,
        )
    row = usable(session, name)
    if row.device_id != device_id:
        raise CalibrationOfAnotherDevice(
            f'calibration "{row.id}" is of device "{row.device_id}"; the measurements are of '
            f'"{device_id}"',
            calibration=row.id,
            device=device_id,
        )
    return row


@router.get("/runs", operation_id="list-runs", summary="List runs")
def list_runs(
    database: DatabaseDep,
    device: DeviceFilter = None,
    kind: Annotated[Kind | None, Query(description="Only those of this kind.")] = None,
    state: Annotated[State | None, Query(description="Only those in this state.")] = None,
    limit: Limit = 50,
    offset: Offset = 0,
) -> Page[Run]:
    """Runs of all kinds, newest first."""
    with database.read() as session:
        rows, total = store.list_runs(session, device, kind, state, limit, offset)
        items = [run_document(row) for row in rows]
    return Page(items=items, total=total, limit=limit, offset=offset)


@router.get(
    "/runs/{run_id}",
    operation_id="get-run",
    summary="How far a run is",
    responses=problems(UnknownRun),
)
def get_run(run_id: RunPath, database: DatabaseDep) -> Run:
    """State, progress, and what came of it."""
    with database.read() as session:
        return run_document(store.get_run(session, run_id))


@router.delete(
    "/runs/{run_id}",
    operation_id="delete-run",
    summary="Delete a run",
    status_code=HTTP_204_NO_CONTENT,
    responses=problems(UnknownRun, RunNotEnded),
)
def delete_run(run_id: RunPath, database: DatabaseDep) -> None:
    """Delete a run that has ended, with the measurements posted for it; what it made stays."""
    with database.write() as session:
        store.delete_run(session, run_id)


@router.post(
    "/runs/{run_id}/cancel",
    operation_id="cancel-run",
    summary="Cancel a run",
    responses=problems(UnknownRun),
)
def cancel_run(run_id: RunPath, database: DatabaseDep, runs: RunsDep) -> Run:
    """End a run that waits or runs; nothing of it is stored. One that has ended stays as it is."""
    with database.write() as session:
        found = run_document(store.cancel(session, run_id))
    runs.cancelled(run_id)
    return found
