"""REST resource /api/v1/line-scans, and the newest scans of a device; stateless."""

from functools import partial
from typing import Annotated, Final

import numpy as np
from fastapi import Body, Depends, Query, Request
from starlette.responses import Response

from compute.errors import InvalidParameter
from service.api.concurrency_limit import ConcurrencyLimit
from service.api.devices.profiles import find_profile
from service.api.devices.store import get_device
from service.api.inputs import DatabaseDep, DevicePath, JsonTypes, LiveDep
from service.api.line_scans.chain_steps import ChainMethod
from service.api.line_scans.examples import NEW_LINE_SCANS
from service.api.line_scans.live_scans import (
    AfterQuery,
    DetailQuery,
    MarkerQuery,
    live_scans,
)
from service.api.line_scans.mask_method import MaskMethod
from service.api.line_scans.noise import NoiseConstants
from service.api.line_scans.peak_search import Scans, find_peaks
from service.api.line_scans.schema import (
    CHAIN_PIXELS,
    CHAIN_TOTAL_PIXELS,
    CORRELATION_VALUES,
    DETAIL_PIXELS,
    MAX_SCANS,
    MAX_TOTAL_PIXELS,
    DeviceScans,
    LineScanRequest,
    LineScans,
    PixelNoise,
)
from service.api.openapi import ResourceRouter, raises
from service.pipeline.detection_stage import FindProfile

router = ResourceRouter("/api/v1", "line-scans")

MAX_CONCURRENT: Final = 2
"""Requests computed at the same time: long scans take seconds, and threads are for all."""

_limit = ConcurrencyLimit(
    MAX_CONCURRENT,
    f"the peaks of {MAX_CONCURRENT} requests are being found; send this one again in a few seconds",
)

_PNG = {"content": {"image/png": {"schema": {"type": "string", "format": "binary"}}}}

NewLineScansBody = Annotated[LineScanRequest, JsonTypes(), Body(openapi_examples=NEW_LINE_SCANS)]
ScanQuery = Annotated[
    int,
    Query(
        ge=0,
        lt=MAX_SCANS,
        description="Number of the line to draw, from 0; of averaged scans any one.",
        examples=[0],
    ),
]


def _find_profile(request: Request) -> FindProfile:
    return partial(find_profile, profiles_dir=request.app.state.settings.folders.profiles)


ProfileFinder = Annotated[FindProfile, Depends(_find_profile)]


@router.operation(
    "POST /line-scans", "find-peaks", "Find the peaks of scans", response_model=LineScans
)
@raises("invalid-parameter", "busy")
def find_peaks_of_scans(request: NewLineScansBody, profile: ProfileFinder) -> Response:
    """Find the peaks of the scans that you post, by the method that you choose.

    Nothing is stored. With `detail`, for each pixel what the method made of it.
    """
    with _limit:
        found = find_peaks(
            _request_scans(request),
            request.method,
            _request_noise(request),
            detail=request.detail,
            find_profile=profile,
        )
        # Here and not by the framework, which would write it in the event loop.
        content = found.model_dump_json()
    return Response(content, media_type="application/json")


@router.operation(
    "POST /line-scans.png",
    "draw-peaks",
    "Draw a line and its peaks",
    responses={200: _PNG},
    response_class=Response,
)
@raises("invalid-parameter", "busy")
def draw_peaks_of_scan(
    request: NewLineScansBody, profile: ProfileFinder, scan: ScanQuery = 0
) -> Response:
    """One of the scans as a picture (PNG): its peaks and their fits."""
    # Matplotlib is loaded by who wants a picture.
    from service.api.line_scans.plot import draw_scan

    with _limit:
        scans = _request_scans(request)
        chosen = select_scan(scans, scan, getattr(request.method, "average", None) or 1)
        method = request.method
        if isinstance(method, MaskMethod):
            method = method.of_line(scan, profile)
        found = find_peaks(
            chosen, method, _request_noise(request), detail=True, find_profile=profile
        )
        picture = draw_scan(chosen[0], found, method, f"scan {scan}")
    return Response(picture, media_type="image/png")


@router.operation(
    "GET /devices/{device_id}/scans",
    "get-device-scans",
    "What the sensors of a device see now",
    response_model=DeviceScans,
)
@raises("unknown-device", "device-not-running", "invalid-parameter", "busy")
def get_device_scans(
    device_id: DevicePath,
    database: DatabaseDep,
    live: LiveDep,
    after: AfterQuery = None,
    marker: MarkerQuery = None,
    detail_sensor: DetailQuery = None,
) -> Response:
    """The pixels of the next exposure, as an oscilloscope shows them: levels, peaks, fits.

    Peaks are those of the stream. Ask again with `after` for a later one; that some requests a
    second are made is meant, more than ten are not.
    """
    with database.read() as session:
        get_device(session, device_id)
    found = live_scans(live, device_id, after, marker, detail_sensor)
    # Here and not by the framework, which would write it in the event loop.
    return Response(found.model_dump_json(), media_type="application/json")


def select_scan(scans: Scans, scan: int, average: int) -> Scans:
    """Return a line, or those that it is averaged with, shape (average, P).

    Raises:
        InvalidParameter: there is no such line, or too few to average.
    """
    if scan >= len(scans):
        raise InvalidParameter(
            f"scan is {scan}; the scans that were posted have the numbers 0 to {len(scans) - 1}",
            scan=scan,
        )
    first = scan // average * average
    return scans[first : first + average]


def _request_scans(request: LineScanRequest) -> Scans:
    """Return the scans of a request, shape (L, P); raises InvalidParameter."""
    length = len(request.scans[0])
    for number, scan in enumerate(request.scans):
        if len(scan) != length:
            raise InvalidParameter(
                f"scans.{number} has {len(scan)} values and scans.0 has {length}; all scans must "
                "be of one length",
                scan=number,
                length=len(scan),
            )
    values = length * len(request.scans)
    max_values, how = MAX_TOTAL_PIXELS, "at once"
    if isinstance(request.method, ChainMethod):
        max_values, how = CHAIN_TOTAL_PIXELS, "for the method chain"
    elif request.detail:
        max_values, how = DETAIL_PIXELS, "with detail"
    if values > max_values:
        raise InvalidParameter(
            f"the scans have {values} values; {how} they may have {max_values}: send them in "
            "several requests",
            values=values,
        )
    if isinstance(request.method, ChainMethod) and length > CHAIN_PIXELS:
        raise InvalidParameter(
            f"the scans have {length} values; for the method chain they may have {CHAIN_PIXELS}",
            length=length,
        )
    _check_correlations(request, length)
    return np.array(request.scans, dtype=np.uint16)


def _check_correlations(request: LineScanRequest, length: int) -> None:
    """Raise InvalidParameter where the correlations that detail has would fill the memory."""
    method = request.method
    if not (request.detail and isinstance(method, MaskMethod) and method.template):
        return
    readings = length + len(method.template.cells) // method.template.per_px
    values = readings * len(request.scans)
    if values > CORRELATION_VALUES:
        raise InvalidParameter(
            f"the correlations of {len(request.scans)} scans with this template have {values} "
            f"values; with detail they may have {CORRELATION_VALUES}: send fewer scans at once",
            values=values,
        )


def _request_noise(request: LineScanRequest) -> PixelNoise | NoiseConstants | None:
    """Return what a request says about the noise; raises InvalidParameter."""
    if request.offset_counts is None:
        return request.noise
    if request.noise is not None:
        raise InvalidParameter(
            f"offset_counts is {request.offset_counts} beside noise, which has an offset_counts "
            "of its own; give it there",
            offset_counts=request.offset_counts,
        )
    return NoiseConstants(offset_counts=request.offset_counts)
