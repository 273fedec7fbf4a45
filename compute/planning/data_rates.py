"""Measurement and data rates of a device, [3.1]-[3.3]."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from compute.parameter_checks import require

Illumination = Literal["strobed", "simultaneous"]

READING_BYTES = 8
"""A reduced reading: position and standard deviation as float32."""


@dataclass(frozen=True)
class Rates:
    """Rates of a device with N markers.

    Args:
        markers: N.
        illumination: one marker after the other ("strobed"), or all at once ("simultaneous").
        line_rate_hz: r_s, lines of each sensor per second.
        marker_rate_hz: how often each marker is seen: r_s [3.2], or r_s / N [3.3].
        points_per_s: marker positions per second, all markers together: N r_s [3.1] of markers
            lit together, r_s of strobed ones.
        raw_pixels_per_s: pixels that all sensors read out.
        raw_bytes_per_s: the same in bytes, a pixel in whole bytes.
        reduced_bytes_per_s: readings of all sensors instead of their pixels, 8 bytes each.
        reduction: raw over reduced bytes.
    """

    markers: int
    illumination: Illumination
    line_rate_hz: float
    marker_rate_hz: float
    points_per_s: float
    raw_pixels_per_s: float
    raw_bytes_per_s: float
    reduced_bytes_per_s: float
    reduction: float


def rates(
    markers: int,
    line_rate_hz: float,
    illumination: Illumination,
    *,
    sensors: int,
    pixels: int,
    bits: int,
) -> Rates:
    """Compute the rates of a device; thesis section 3.2.1, [3.1]-[3.3].

    [3.1] counts the N peaks of each line; strobed, a line holds one of them. A line rate counts
    exposures, so it already holds whatever dark frames a device needs between them.

    Args:
        markers: N, at least 1.
        line_rate_hz: r_s, positive.
        illumination: "strobed" or "simultaneous".
        sensors: sensors of the device, at least 1.
        pixels: pixels of a line, at least 1.
        bits: resolution of a pixel's count, 1 to 32.

    Raises:
        InvalidParameter: a value is out of range.
    """
    for name, value in (("markers", markers), ("sensors", sensors), ("pixels", pixels)):
        require(value >= 1, "be at least 1", **{name: value})
    require(0.0 < line_rate_hz < np.inf, "be positive", line_rate_hz=line_rate_hz)
    require(1 <= bits <= 32, "be 1 to 32", bits=bits)
    kinds = get_args(Illumination)
    require(illumination in kinds, "be strobed or simultaneous", illumination=illumination)
    together = illumination == "simultaneous"
    points = line_rate_hz * (markers if together else 1)
    raw_pixels = line_rate_hz * sensors * pixels
    raw_bytes = raw_pixels * -(-bits // 8)
    reduced = points * sensors * READING_BYTES
    return Rates(
        markers,
        illumination,
        line_rate_hz,
        line_rate_hz if together else line_rate_hz / markers,
        points,
        raw_pixels,
        raw_bytes,
        reduced,
        raw_bytes / reduced,
    )
