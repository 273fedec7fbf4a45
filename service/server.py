"""Health, the landing page, and what problem types mean."""

import html
from typing import TYPE_CHECKING, Annotated, Literal

from fastapi import APIRouter, Path, Request
from sqlalchemy.exc import SQLAlchemyError
from starlette.responses import HTMLResponse, JSONResponse, Response

from service.database.engine import Database
from service.dependencies import DatabaseDep
from service.errors import NotReady, UnknownProblem
from service.openapi import problems
from service.problems import PROBLEM_TYPES, ProblemType
from service.schema import Document

if TYPE_CHECKING:
    from service.live.manager import LiveManager

router = APIRouter(tags=["server"])


class Health(Document):
    """The process answers."""

    status: Literal["ok"] = "ok"


class Landing(Document):
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
        },
    )


@router.get("/healthz", operation_id="get-health", summary="Is the process alive?")
def get_health() -> Health:
    """Answers as long as the process does."""
    return Health()


@router.get(
    "/readyz",
    operation_id="get-readiness",
    summary="Can requests be served?",
    responses=problems(NotReady),
)
def get_readiness(request: Request, database: DatabaseDep) -> Health:
    """Answers 200 when the database answers and the live pipeline runs."""
    _check_database(database)
    live: LiveManager | None = request.app.state.live
    if live is None or not live.ready:
        raise NotReady("the live pipeline does not run; restart the server", part="live")
    return Health()


def _check_database(database: Database) -> None:
    try:
        database.check()
    except SQLAlchemyError as error:
        # Not the error's text: it may hold the URL with the password.
        raise NotReady(
            f"the database does not answer ({type(error).__name__}); it must accept connections",
            part="database",
        ) from error


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
