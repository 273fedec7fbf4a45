"""REST resource /api/v1/runs: progress, cancelling, deleting."""

from typing import Annotated

from fastapi import APIRouter, Query

from service.api.inputs import DatabaseDep, DeviceFilter, RunsDep, id_in_path
from service.api.openapi import ResourceRouter, raises
from service.api.paging import Page, PagingDep, page_of
from service.api.runs import submit_router
from service.api.runs.schema import Run, run_document
from service.jobs import store
from service.jobs.store import Kind, State

router = APIRouter()
router.include_router(submit_router.router)
_runs = ResourceRouter("/api/v1/runs", "runs")

RunPath = Annotated[str, id_in_path("The run's id.", "sim-frame-run", "frame")]


@_runs.operation("GET", "list-runs", "List runs")
def list_runs(
    database: DatabaseDep,
    paging: PagingDep,
    device_id: DeviceFilter = None,
    kind: Annotated[Kind | None, Query(description="Only those of this kind.")] = None,
    state: Annotated[State | None, Query(description="Only those in this state.")] = None,
) -> Page[Run]:
    """Runs of all kinds, newest first."""
    with database.read() as session:
        return page_of(
            session,
            store.RUNS.newest_first(device_id=device_id, kind=kind, state=state),
            paging,
            run_document,
        )


@_runs.operation("GET /{run_id}", "get-run", "How far a run is")
@raises("unknown-run")
def get_run(run_id: RunPath, database: DatabaseDep) -> Run:
    """State, progress, and what came of it."""
    with database.read() as session:
        return run_document(store.RUNS.get(session, run_id))


@_runs.operation("DELETE /{run_id}", "delete-run", "Delete a run")
@raises("unknown-run", "run-not-ended")
def delete_run(run_id: RunPath, database: DatabaseDep) -> None:
    """Delete a run that has ended, with the measurements posted for it; what it made stays."""
    with database.write() as session:
        store.delete_run(session, run_id)


@_runs.operation("POST /{run_id}/cancel", "cancel-run", "Cancel a run")
@raises("unknown-run")
def cancel_run(run_id: RunPath, database: DatabaseDep, runs: RunsDep) -> Run:
    """End a run that waits or runs; nothing of it is stored. One that has ended stays as it is."""
    with database.write() as session:
        found = run_document(store.cancel(session, run_id))
    runs.cancelled(run_id)
    return found


router.include_router(_runs)
