"""REST resources /api/v1/calibration-runs and /api/v1/runs."""

from typing import Annotated

from fastapi import APIRouter, Body, Path, Query, Response
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
from service.calibrations.schema import ControlPoint
from service.calibrations.store import check_unused
from service.dependencies import DatabaseDep, RunsDep, SettingsDep
from service.devices.store import get_device, sensors_of_row
from service.errors import (
    Busy,
    CalibrationExists,
    RunExists,
    UnknownDevice,
    UnknownRun,
)
from service.json_body import FromJson, JsonRoute
from service.openapi import problems
from service.runs import calibration, store
from service.runs.document import run_document
from service.runs.examples import NEW_CALIBRATION_RUNS
from service.runs.schema import NewCalibrationRun, Run
from service.runs.store import Kind, State
from service.schema import SLUG_PATTERN, DeviceFilter, Limit, Offset, Page

router = APIRouter(prefix="/api/v1", tags=["runs"], route_class=JsonRoute)

NewCalibrationRunBody = Annotated[
    NewCalibrationRun, FromJson(), Body(openapi_examples=NEW_CALIBRATION_RUNS)
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
        RunExists,
        CalibrationExists,
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


def _points(_session: Session, request: NewCalibrationRun) -> list[ControlPoint]:
    """Return the control points that a request gives or names."""
    if request.points is None:
        raise InvalidParameter("there are no points; give points")
    return request.points


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
