"""Endpoints of the server itself: landing page, health, problem types."""

import html
from typing import TYPE_CHECKING, Annotated, Literal

from fastapi import APIRouter, Path, Request
from pydantic import Field
from starlette.responses import HTMLResponse, JSONResponse, Response

from service.api.base_models import ResponseModel
from service.api.inputs import DatabaseDep, RunsDep, SettingsDep
from service.api.openapi import problems
from service.api.recordings.recording_manager import RecordingsDep
from service.application.readiness import check_ready, failed_devices, limits
from service.problems.catalogue import PROBLEM_TYPES, ProblemType
from service.problems.errors import NotReady, UnknownProblem
from service.security.credential import why_not_local

if TYPE_CHECKING:
    from service.pipeline.pipeline_manager import PipelineManager

router = APIRouter(tags=["server"])


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
    """Where to go from here."""

    name: str
    version: str
    links: dict[str, str]


@router.get("/", operation_id="get-landing", summary="Where to go from here")
def get_landing(request: Request) -> Landing:
    """Links to the documentation and the resources."""
    return Landing(
        name=request.app.title,
        version=request.app.version,
        links={
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


@router.get("/healthz", operation_id="get-health", summary="Is the process alive?")
async def get_health() -> Health:
    """Answers as long as the process does, also while all threads wait for the database."""
    return Health()


@router.get(
    "/readyz",
    operation_id="get-readiness",
    summary="Can requests be served?",
    responses=problems(NotReady),
)
def get_readiness(
    request: Request,
    database: DatabaseDep,
    runs: RunsDep,
    recordings: RecordingsDep,
    settings: SettingsDep,
) -> Readiness:
    """Answers 200 when the database answers and is of this version, and all parts run."""
    live: PipelineManager | None = request.app.state.live
    check_ready(database, live, runs, recordings)
    failed = failed_devices(live) if live is not None else []
    address = request.client.host if request.client else "unknown"
    return Readiness(
        limits=limits(recordings),
        failed_devices=len(failed),
        failed=failed if why_not_local(settings, address, request.headers) is None else None,
    )


@router.get("/problems", operation_id="list-problems", summary="List all problem types")
def list_problems() -> list[ProblemType]:
    """All problem types that the server answers with."""
    return list(PROBLEM_TYPES.values())


@router.get(
    "/problems/{code}",
    operation_id="get-problem",
    summary="What a problem type means",
    response_model=ProblemType,
    responses=problems(UnknownProblem)
    | {200: {"content": {"text/html": {"schema": {"type": "string"}}}}},
)
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
    found = PROBLEM_TYPES.get(code)
    if found is None:
        raise UnknownProblem(f'there is no problem type "{code}"; GET /problems lists them')
    if "text/html" in request.headers.get("accept", ""):
        return HTMLResponse(_page(found))
    return JSONResponse(found.model_dump())


def _page(found: ProblemType) -> str:
    title, meaning = html.escape(found.title), html.escape(found.meaning)
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title>'
        f"<h1>{title}</h1><p>{meaning}</p><p>HTTP status {found.status}, type "
        f"<code>{html.escape(found.type)}</code></p></html>"
    )
