"""Endpoints of the server itself: landing page, health, readiness, problem types."""

import html
import shutil
from collections.abc import Iterator
from typing import Annotated, Final, Literal

from fastapi import Path, Request
from pydantic import Field
from sqlalchemy.exc import SQLAlchemyError
from starlette.responses import HTMLResponse, JSONResponse, Response

from service.api.base_models import ResponseModel
from service.api.inputs import DatabaseDep, RunsDep, SettingsDep
from service.api.openapi import ResourceRouter, raises
from service.api.paging import Page, PagingDep, page_of_sequence
from service.api.recordings.recording_manager import RecordingManager, RecordingsDep
from service.database.engine import Database
from service.database.migration import newest_revision, revision_of
from service.jobs.run_manager import RunManager
from service.pipeline.interface import Pipeline
from service.problems.catalogue import PROBLEM_TYPES, ProblemType
from service.problems.errors import NotReady, UnknownProblem
from service.security.credential import why_not_local

STUCK_AFTER_S: Final = 30.0
"""A compute thread that is so long at one batch, or at making ready one device, is stuck."""
MIN_FREE_BYTES: Final = 64 * 2**20
"""Without so much room a SQLite database may fail to be written, and nothing works then."""

_Complaint = tuple[str, str]
"""Of which part, and what is wrong with it."""


def check_ready(
    database: Database,
    live: Pipeline | None,
    runs: RunManager,
    recordings: RecordingManager,
) -> None:
    """Return when requests can be served.

    Raises:
        NotReady: what stands in the way; all of it in the message, the first as ``part``.
    """
    components = [*_database(database), *_live(live), *_runs(runs), *_disk(recordings)]
    if components:
        raise NotReady("; ".join(text for _, text in components), part=components[0][0])


def limits(recordings: RecordingManager) -> list[str]:
    """Return what does not work now although requests are served."""
    free = _free(recordings)
    if free is not None and free < recordings.free_bytes:
        return ["recordings: the disk is too full to begin one"]
    return []


def failed_devices(live: Pipeline) -> list[str]:
    """Return the devices that failed, which keep the others and the server from nothing."""
    return [name for name, status in live.statuses().items() if status.state == "failed"]


def _database(database: Database) -> Iterator[_Complaint]:
    try:
        with database.engine.connect() as connection:
            revision = revision_of(connection)
    except SQLAlchemyError as error:
        # Not the error's text: it may hold the URL with the password.
        kind = type(error).__name__
        text = f"the database does not answer ({kind}); it must accept connections"
        yield "database", text
        return
    newest = newest_revision()
    if revision != newest:
        text = (
            f"the database is of revision {revision}, this version of the service is of {newest}; "
            "restart the server with the version that the database is of"
        )
        yield "database", text


def _live(live: Pipeline | None) -> Iterator[_Complaint]:
    if live is None or not live.ready:
        yield "live", "the live pipeline does not run; restart the server"
        return
    busy_s = live.busy_s
    if busy_s > STUCK_AFTER_S:
        text = f"the live pipeline is at one step for {busy_s:.0f} s; restart the server"
        yield "live", f"{text} when it stays so"


def _runs(runs: RunManager) -> Iterator[_Complaint]:
    if not runs.alive:
        yield "runs", "no runs are taken any more; restart the server"


def _disk(recordings: RecordingManager) -> Iterator[_Complaint]:
    free = _free(recordings)
    if free is None:
        yield "disk", "the folder of recordings cannot be read; it must be there"
    elif free < MIN_FREE_BYTES:
        text = (
            f"{free} bytes are free on the disk of the data directory, which needs "
            f"{MIN_FREE_BYTES}; delete recordings"
        )
        yield "disk", text


def _free(recordings: RecordingManager) -> int | None:
    try:
        return shutil.disk_usage(recordings.library.folder).free
    except OSError:
        return None


router = ResourceRouter("", "server")


class Health(ResponseModel):
    """The process answers."""

    status: Literal["ok"] = "ok"


class Readiness(ResponseModel):
    """Requests can be served."""

    status: Literal["ok"] = "ok"
    limits: list[str] = Field(description="What does not work now although requests are served.")
    failed_devices: int = Field(description="Devices that failed; the others do not depend on it.")
    failed: list[str] | None = Field(
        description="Their ids; null for clients of other machines, who need a key to see them."
    )


class Landing(ResponseModel):
    """Entry point: links to the documentation and the resources."""

    name: str
    version: str
    links: dict[str, str]


@router.operation("GET /api/v1", "get-landing", "Where to go from here")
def get_landing(request: Request) -> Landing:
    """Links to the documentation and the resources."""
    return Landing(
        name=request.app.title,
        version=request.app.version,
        links={
            "dashboard": "/",
            "documentation": "/docs",
            "openapi": "/openapi.json",
            "devices": "/api/v1/devices",
            "calibrations": "/api/v1/calibrations",
            "reconstructions": "/api/v1/reconstructions",
            "stream": "/api/v1/stream",
            "problems": "/problems",
            "health": "/healthz",
            "readiness": "/readyz",
            "metrics": "/metrics",
        },
    )


@router.operation("GET /healthz", "get-health", "Is the process alive?")
async def get_health() -> Health:
    """Answers as long as the process does, also while all threads wait for the database."""
    return Health()


@router.operation("GET /readyz", "get-readiness", "Can requests be served?")
@raises("not-ready")
def get_readiness(
    request: Request,
    database: DatabaseDep,
    runs: RunsDep,
    recordings: RecordingsDep,
    settings: SettingsDep,
) -> Readiness:
    """Answers 200 when the database answers and is of this version, and all parts run."""
    live: Pipeline | None = request.app.state.live
    check_ready(database, live, runs, recordings)
    failed = failed_devices(live) if live is not None else []
    address = request.client.host if request.client else "unknown"
    return Readiness(
        limits=limits(recordings),
        failed_devices=len(failed),
        failed=failed if why_not_local(settings, address, request.headers) is None else None,
    )


@router.operation("GET /problems", "list-problems", "List all problem types")
def list_problems(paging: PagingDep) -> Page[ProblemType]:
    """All problem types that the server answers with."""
    return page_of_sequence(
        list(PROBLEM_TYPES.values()), paging, lambda kind: kind, lambda kind: (kind.code,)
    )


@router.operation(
    "GET /problems/{code}",
    "get-problem",
    "What a problem type means",
    response_model=ProblemType,
    responses={200: {"content": {"text/html": {"schema": {"type": "string"}}}}},
)
@raises("unknown-problem")
def get_problem(
    request: Request,
    code: Annotated[
        str,
        Path(
            description="Last part of the problem's `type`.",
            openapi_examples={"coplanar": {"value": "coplanar-points"}},
        ),
    ],
) -> Response:
    """The meaning of a problem type, as JSON or, for a browser, as HTML."""
    problem_type = PROBLEM_TYPES.get(code)
    if problem_type is None:
        raise UnknownProblem(f'there is no problem type "{code}"; GET /problems lists them')
    if "text/html" in request.headers.get("accept", ""):
        return HTMLResponse(_page(problem_type))
    return JSONResponse(problem_type.model_dump())


def _page(problem_type: ProblemType) -> str:
    title, meaning = html.escape(problem_type.title), html.escape(problem_type.meaning)
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title>'
        f"<h1>{title}</h1><p>{meaning}</p><p>HTTP status {problem_type.status}, type "
        f"<code>{html.escape(problem_type.type)}</code></p></html>"
    )
