"""Arrays of scans and noise from a request, validated."""

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from service.api.line_scans.chain_steps import ChainMethod
from service.api.line_scans.mask_method import MaskMethod
from service.api.line_scans.noise import NoiseConstants
from service.api.line_scans.schema import (
    CHAIN_PIXELS,
    CHAIN_TOTAL_PIXELS,
    CORRELATION_VALUES,
    DETAIL_PIXELS,
    MAX_TOTAL_PIXELS,
    LineScanRequest,
    PixelNoise,
)

Scans = NDArray[np.uint16]


def request_scans(request: LineScanRequest) -> Scans:
    """Return the scans of a request, shape (L, P).

    Raises:
        InvalidParameter: scans of different lengths, or more values than one request may have.
    """
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
    max_values, how = (
        (DETAIL_PIXELS, "with detail") if request.detail else (MAX_TOTAL_PIXELS, "at once")
    )
    if isinstance(request.method, ChainMethod):
        max_values, how = CHAIN_TOTAL_PIXELS, "for the method chain"
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


def request_noise(request: LineScanRequest) -> PixelNoise | NoiseConstants | None:
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
    return NoiseConstants(offset_counts=request.offset_counts)
