"""Integer filter taps with exactly zero response to a constant or linear background."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Taps = NDArray[np.int64]

MAX_ABSOLUTE_SUM = 32768
"""Largest sum of |taps|: times 65535, the largest pixel, it stays below 2^31."""


def remove_background(shape: Array, *, slope: bool) -> Array:
    """Return a shape less its mean (and slope), the part that looks like background.

    The result is the matched filter of the shape in white noise over a background that is
    unknown but constant (or straight) under the filter: the projection of the shape on what is
    orthogonal to it.

    Args:
        shape: shape (T,).
        slope: take off the straight line, not the constant alone.
    """
    rest: Array = shape - shape.mean()
    if slope and len(shape) > 2:
        ramp = np.arange(len(shape)) - (len(shape) - 1) / 2.0
        rest = rest - ramp * (ramp @ rest) / (ramp @ ramp)
    return rest


def round_taps(real: Array, *, slope: bool) -> Taps:
    """Round taps to integers whose sum (and first moment) is exactly zero, shape (T,).

    The sum that rounding leaves is taken off where it comes nearest to the taps as they were.
    Symmetric taps stay symmetric, which makes their first moment zero too.

    Args:
        real: taps of sum zero (and first moment zero), shape (T,).
        slope: make the first moment zero as well.
    """
    length = len(real)
    if length % 2 == 1 and np.allclose(real, real[::-1], rtol=0.0, atol=1e-9):
        half = length // 2
        taps = np.rint(real).astype(np.int64)
        taps[half + 1 :] = taps[:half][::-1]
        pairs = int(taps.sum()) // 2
        _subtract_excess(taps[:half], real[:half], pairs)
        taps[half + 1 :] = taps[:half][::-1]
        taps[half] -= taps.sum()
        return taps
    taps = np.rint(real).astype(np.int64)
    _subtract_excess(taps, real, int(taps.sum()))
    if slope:
        _zero_first_moment(taps)
    return taps


def _subtract_excess(taps: Taps, real: Array, excess: int) -> None:
    """Lower (or raise) taps by one, in all ``excess``, where rounding went the other way most."""
    step = 1 if excess > 0 else -1
    for _ in range(abs(excess)):
        taps[np.argmax(step * (taps - real))] -= step


def _zero_first_moment(taps: Taps) -> None:
    """Move ones between taps until the first moment is zero; the sum stays."""
    length = len(taps)
    moment = int((np.arange(length) * taps).sum())
    place = length // 3
    while moment != 0:
        lag = min(abs(moment), length - 1)
        step = 1 if moment > 0 else -1
        place = (place + 1) % (length - lag)
        taps[place] += step
        taps[place + lag] -= step
        moment -= step * lag
