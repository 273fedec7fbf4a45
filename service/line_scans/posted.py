"""Lines and noise of a request, checked."""

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from service.line_scans.chain_steps import ChainMethod
from service.line_scans.mask_method import MaskMethod
from service.line_scans.noise import KnownNoise
from service.line_scans.schema import (
    CHAIN_PIXELS,
    CHAIN_TOTAL_PIXELS,
    CORRELATION_VALUES,
    DETAIL_PIXELS,
    MOST_PIXELS,
    NewLineScans,
    PixelNoise,
)

Lines = NDArray[np.uint16]


def posted_lines(request: NewLineScans) -> Lines:
    """Return the lines of a request, shape (L, P).

    Raises:
        InvalidParameter: lines of different lengths, or more values than one request may have.
    """
    length = len(request.lines[0])
    for number, line in enumerate(request.lines):
        if len(line) != length:
            raise InvalidParameter(
                f"lines.{number} has {len(line)} values and lines.0 has {length}; all lines must "
                "be of one length",
                line=number,
                length=len(line),
            )
    values = length * len(request.lines)
    most, how = (DETAIL_PIXELS, "with detail") if request.detail else (MOST_PIXELS, "at once")
    if isinstance(request.method, ChainMethod):
        most, how = CHAIN_TOTAL_PIXELS, "for the method chain"
    if values > most:
        raise InvalidParameter(
            f"the lines have {values} values; {how} they may have {most}: send them in several "
            "requests",
            values=values,
        )
    if isinstance(request.method, ChainMethod) and length > CHAIN_PIXELS:
        raise InvalidParameter(
            f"the lines have {length} values; for the method chain they may have {CHAIN_PIXELS}",
            length=length,
        )
    _check_correlations(request, length)
    return np.array(request.lines, dtype=np.uint16)


def _check_correlations(request: NewLineScans, length: int) -> None:
    """Raise InvalidParameter where the correlations that detail has would fill the memory."""
    method = request.method
    if not (request.detail and isinstance(method, MaskMethod) and method.template):
        return
    readings = length + len(method.template.cells) // method.template.per_px
    values = readings * len(request.lines)
    if values > CORRELATION_VALUES:
        raise InvalidParameter(
            f"the correlations of {len(request.lines)} lines with this template have {values} "
            f"values; with detail they may have {CORRELATION_VALUES}: send fewer lines at once",
            values=values,
        )


def posted_noise(request: NewLineScans) -> PixelNoise | KnownNoise | None:
    """Return what a request says about the noise.

    Raises:
        InvalidParameter: the offset is told twice.
    """
    if request.offset_counts is None:
        return request.noise
    if request.noise is not None:
        raise InvalidParameter(
            f"offset_counts is {request.offset_counts} beside noise, which has an offset_counts "
            "of its own; give it there",
            offset_counts=request.offset_counts,
        )
    return KnownNoise(offset_counts=request.offset_counts)
