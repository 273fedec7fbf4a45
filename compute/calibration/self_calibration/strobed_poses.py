"""Poses of a moved target whose markers are lit one after the other."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter

Array = NDArray[np.float64]

MAX_GAP_CYCLES: Final = 1.5
"""Longest time between two readings of a marker that are interpolated, in strobe cycles."""
MIN_MOTION: Final = 0.02
"""Share of the pixels by which a reading must have changed since the pose before, on the mean of
the markers and sensors: nearly equal poses say nothing new."""


@dataclass(frozen=True, eq=False)
class StrobedReadings:
    """Readings of F exposures, each of one lit marker.

    Args:
        time_s: middle of the exposures, increasing, shape (F,) [s].
        marker: number of the lit marker, shape (F,); negative: all were lit.
        readings_px: shape (F, S) [px]; NaN where not seen.
        sigma_px: standard deviations, shape (F, S) [px].
    """

    time_s: Array
    marker: NDArray[np.intp]
    readings_px: Array
    sigma_px: Array


def strobed_poses(
    exposures: StrobedReadings,
    markers: Sequence[int],
    pixels: Sequence[int],
    previous_px: Array | None = None,
) -> tuple[Array, Array]:
    """Return the readings of a target's K markers at the same instants, and their sigmas.

    A pose is taken at exposures of the first marker. The readings of the others are interpolated
    linearly between their exposures before and after; what moves at 2 m/s^2 in a cycle of 4 ms is
    then off by 0.004 mm. Poses that hardly differ from the one before are left out.

    Args:
        exposures: readings in the order of time.
        markers: numbers of the target's markers, in the target's order, shape (K,).
        pixels: of the S sensors.
        previous_px: readings of the last pose before, shape (K, S) [px]; None: there is none.

    Returns:
        Readings and standard deviations, shape (B, K, S) [px]; NaN where not seen.

    Raises:
        InvalidParameter: a marker is given twice or was never lit.
    """
    if len(set(markers)) != len(markers):
        raise InvalidParameter(f"markers {list(markers)} has one twice; each has its own number")
    lit = [np.flatnonzero(exposures.marker == one) for one in markers]
    for number, rows in zip(markers, lit, strict=True):
        if len(rows) == 0:
            strobed = sorted({int(one) for one in exposures.marker if one >= 0})
            what = f"markers {strobed} are" if strobed else "all markers are lit together: none is"
            raise InvalidParameter(
                f"marker {number} was never lit alone; {what} strobed", marker=int(number)
            )
    time = exposures.time_s[lit[0]]
    sensors = exposures.readings_px.shape[1]
    readings = np.full((len(time), len(markers), sensors), np.nan)
    sigma = np.full(readings.shape, np.nan)
    readings[:, 0], sigma[:, 0] = exposures.readings_px[lit[0]], exposures.sigma_px[lit[0]]
    cycle = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    for column, rows in enumerate(lit[1:], start=1):
        if len(rows) < 2:
            continue
        own = exposures.time_s[rows]
        after = np.clip(np.searchsorted(own, time), 1, len(rows) - 1)
        span = own[after] - own[after - 1]
        share = (time - own[after - 1]) / span
        known = (share >= 0.0) & (share <= 1.0) & (span <= MAX_GAP_CYCLES * cycle)
        share = np.where(known, share, np.nan)[:, None]
        first, second = rows[after - 1], rows[after]
        readings[:, column] = (1.0 - share) * exposures.readings_px[first]
        readings[:, column] += share * exposures.readings_px[second]
        sigma[:, column] = np.hypot(
            (1.0 - share) * exposures.sigma_px[first], share * exposures.sigma_px[second]
        )
    chosen = _distinct(readings, np.asarray(pixels, dtype=np.float64), previous_px)
    return readings[chosen], sigma[chosen]


def _distinct(readings: Array, pixels: Array, last: Array | None) -> NDArray[np.intp]:
    """Return indices of poses of which each differs from the one before."""
    seen = np.isfinite(readings)
    rows = np.flatnonzero((seen.sum(axis=2) >= 3).all(axis=1))
    chosen: list[int] = []
    for row in rows.tolist():
        if last is not None:
            change = np.abs(readings[row] - last) / pixels
            both = np.isfinite(change)
            if both.any() and change[both].mean() < MIN_MOTION:
                continue
        chosen.append(row)
        last = readings[row]
    return np.array(chosen, dtype=np.intp)
