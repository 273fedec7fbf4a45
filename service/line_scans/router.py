"""REST resource /api/v1/line-scans: stateless, computed in the request's own thread."""

from functools import partial
from threading import BoundedSemaphore
from typing import Annotated, Final

from fastapi import APIRouter, Body, Depends, Query, Request
from starlette.responses import Response

from compute.errors import InvalidParameter
from service.devices.profiles import find_profile
from service.errors import Busy
from service.json_body import FromJson, JsonRoute
from service.line_scans.examples import NEW_LINE_SCANS
from service.line_scans.mask_method import MaskMethod
from service.line_scans.posted import Lines, posted_lines, posted_noise
from service.line_scans.run import find_peaks
from service.line_scans.schema import MOST_LINES, LineScans, NewLineScans
from service.live.line_model import FindProfile
from service.openapi import problems

router = APIRouter(prefix="/api/v1", tags=["line-scans"], route_class=JsonRoute)

AT_ONCE: Final = 2
"""Requests computed at the same time: long lines take seconds, and threads are for all."""

_slots = BoundedSemaphore(AT_ONCE)

_PNG = {"content": {"image/png": {"schema": {"type": "string", "format": "binary"}}}}

NewLineScansBody = Annotated[NewLineScans, FromJson(), Body(openapi_examples=NEW_LINE_SCANS)]
LineQuery = Annotated[
    int,
    Query(
        ge=0,
        lt=MOST_LINES,
        description="Number of the line to draw, from 0; of averaged lines any one.",
        examples=[0],
    ),
]


def _find_profile(request: Request) -> FindProfile:
    return partial(find_profile, profiles_dir=request.app.state.settings.folders.profiles)


ProfileFinder = Annotated[FindProfile, Depends(_find_profile)]


@router.post(
    "/line-scans",
    operation_id="find-peaks",
    summary="Find the peaks of lines",
    response_model=LineScans,
    responses=problems(InvalidParameter, Busy),
)
def find_peaks_of_lines(request: NewLineScansBody, profile: ProfileFinder) -> Response:
    """Find the peaks of the lines that you post, by the method that you choose.

    Nothing is stored. With `detail`, for each pixel what the method made of it.
    """
    with _Slot():
        found = find_peaks(
            posted_lines(request),
            request.method,
            posted_noise(request),
            detail=request.detail,
            find_profile=profile,
        )
        # Here and not by the framework, which would write it in the event loop.
        content = found.model_dump_json()
    return Response(content, media_type="application/json")


@router.post(
    "/line-scans.png",
    operation_id="draw-peaks",
    summary="Draw a line and its peaks",
    response_class=Response,
    responses=problems(InvalidParameter, Busy) | {200: _PNG},
)
def draw_peaks_of_line(
    request: NewLineScansBody, profile: ProfileFinder, line: LineQuery = 0
) -> Response:
    """One of the lines as a picture (PNG): its peaks, and what was fitted to them."""
    # Matplotlib is loaded by who wants a picture.
    from service.line_scans.picture import draw_line

    with _Slot():
        lines = posted_lines(request)
        chosen = chosen_line(lines, line, getattr(request.method, "average", None) or 1)
        method = request.method
        if isinstance(method, MaskMethod):
            method = method.of_line(line, profile)
        found = find_peaks(chosen, method, posted_noise(request), detail=True, find_profile=profile)
        picture = draw_line(chosen[0], found, method, f"line {line}")
    return Response(picture, media_type="image/png")


def chosen_line(lines: Lines, line: int, average: int) -> Lines:
    """Return a line, or those that it is averaged with, shape (average, P).

    Raises:
        InvalidParameter: there is no such line, or too few to average.
    """
    if line >= len(lines):
        raise InvalidParameter(
            f"line is {line}; the lines that were posted have the numbers 0 to {len(lines) - 1}",
            line=line,
        )
    first = line // average * average
    return lines[first : first + average]


class _Slot:
    """One of the computations that may run at once."""

    def __enter__(self) -> None:
        if not _slots.acquire(blocking=False):
            raise Busy(
                f"the peaks of {AT_ONCE} requests are being found; send this one again in a few "
                "seconds"
            )

    def __exit__(self, *_: object) -> None:
        _slots.release()
