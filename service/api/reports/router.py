"""REST resource /api/v1/calibrations/{id}/report.html and its figures."""

from collections.abc import Callable
from functools import partial
from typing import Annotated, Final, Literal

from fastapi import Depends, Path, Query, Request
from starlette.responses import HTMLResponse, Response

from service.api.base_models import SLUG_PATTERN
from service.api.concurrency_limit import ConcurrencyLimit
from service.api.inputs import CalibrationPath, DatabaseDep
from service.api.openapi import ResourceRouter, raises
from service.api.reports.assembly import assemble_report, report_key
from service.api.reports.cache import ReportCache
from service.api.reports.content import ReportContent
from service.api.reports.render_process import render_figure, render_page
from service.database.engine import Database
from service.problems.errors import (
    NoSuchFigure,
)

router = ResourceRouter("/api/v1/calibrations", "calibrations")

MAX_CONCURRENT: Final = 2
"""Reports made at the same time: each takes seconds, and threads are for all."""

_limit = ConcurrencyLimit(
    MAX_CONCURRENT,
    f"{MAX_CONCURRENT} reports are being made; ask for this one again in a few seconds",
)

_PNG: Final = {"content": {"image/png": {"schema": {"type": "string", "format": "binary"}}}}
_HTML: Final = {"content": {"text/html": {"schema": {"type": "string"}}}}

FigureName = Literal[
    "residuals-order",
    "residuals-position",
    "residuals-pixels",
    "residuals-histogram",
    "coverage",
    "point-errors",
    "uncertainty",
    "comparison",
]
FigurePath = Annotated[
    str,
    Path(
        pattern=SLUG_PATTERN,
        description="The calibration's id.",
        openapi_examples={"frame": {"summary": "of the example body", "value": "sim-frame"}},
    ),
]


def _reports(request: Request) -> ReportCache:
    reports: ReportCache = request.app.state.reports
    return reports


ReportsDep = Annotated[ReportCache, Depends(_reports)]
PreviousQuery = Annotated[
    str | None,
    Query(
        pattern=SLUG_PATTERN,
        description="The calibration to compare with; left out: the one that was active before, "
        "or is active.",
    ),
]


@router.operation(
    "GET /{calibration_id}/report.html",
    "get-calibration-report",
    "The report of a calibration",
    responses={200: _HTML},
    response_class=HTMLResponse,
)
@raises("unknown-calibration", "calibration-of-another-device", "busy")
def get_report(
    calibration_id: CalibrationPath,
    database: DatabaseDep,
    kept: ReportsDep,
    previous_calibration_id: PreviousQuery = None,
) -> HTMLResponse:
    """One HTML file that needs nothing else: to read, to print, to keep."""
    page = _rendered(
        calibration_id,
        previous_calibration_id,
        database,
        kept,
        lambda content: render_page(content).encode(),
    )
    return HTMLResponse(page)


@router.operation(
    "GET /{calibration_id}/report/{figure}.png",
    "get-calibration-figure",
    "One figure of a calibration's report",
    responses={200: _PNG},
    response_class=Response,
)
@raises("unknown-calibration", "calibration-of-another-device", "no-such-figure", "busy")
def get_figure(
    calibration_id: FigurePath,
    figure: Annotated[
        FigureName,
        Path(openapi_examples={"order": {"value": "residuals-order"}}, description="Its name."),
    ],
    database: DatabaseDep,
    kept: ReportsDep,
    previous_calibration_id: PreviousQuery = None,
) -> Response:
    """The figure as PNG."""
    drawn = _rendered(
        calibration_id,
        previous_calibration_id,
        database,
        kept,
        partial(render_figure, figure),
        f"/{figure}",
    )
    if drawn is None:
        raise NoSuchFigure(
            f'the report of calibration "{calibration_id}" has no figure {figure}: there are no '
            "control points, residuals or other calibration for it",
            calibration_id=calibration_id,
            figure=figure,
        )
    return Response(drawn, media_type="image/png")


def _rendered(
    calibration_id: str,
    previous_calibration_id: str | None,
    database: Database,
    kept: ReportCache,
    render: Callable[[ReportContent], bytes | None],
    part: str = "",
) -> bytes | None:
    """Return a part of a report from the cache, else rendered; None: there is nothing for it."""
    with database.read() as session:
        key = report_key(session, calibration_id, previous_calibration_id) + part
    rendered = kept.get(key)
    if rendered is None:
        with _limit:
            with database.read() as session:
                content = assemble_report(session, calibration_id, previous_calibration_id)
            rendered = render(content)
        if rendered is not None:
            kept.keep(key, rendered)
    return rendered
