"""Positions of two targets put into two subsets in the order of their detection: section 6.1.2."""

from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter

Array = NDArray[np.float64]

Single = Literal["nearest", "first"]
"""Where a lone point goes; ``order_by_detection`` says what each is."""


def order_by_detection(position_px: Array, single: Single = "nearest") -> Array:
    """Return Subset 1 and Subset 2 of each scan, shape (N, 2), NaN where a point is missing.

    A line is read from its first pixel on, so that the order of detection is that of place:
    Subset 1 holds the target that is on the left, whichever it is, and the two curves never
    cross. Of more than two points the outermost are taken.

    A scan with one point only, because a target was not seen or covered the other, leaves a gap
    in one of the subsets. Which, the text does not say: "first" is what its words come to, the
    point detected first is Subset 1's; "nearest" puts it where the last point is nearer.

    Args:
        position_px: detected positions of N scans, shape (N, K) [px], NaN where there is none.
        single: where a lone point goes.

    Raises:
        InvalidParameter: positions of another shape, or an unknown way.
    """
    values = np.asarray(position_px, dtype=np.float64)
    if values.ndim != 2:
        raise InvalidParameter(
            f"positions have the shape {values.shape}; they must be (scans, peaks)",
            shape=values.shape,
        )
    if single not in get_args(Single):
        raise InvalidParameter(
            f"single is {single!r}; it must be one of {get_args(Single)}", single=single
        )
    subsets = np.full((len(values), 2), np.nan)
    last = np.full(2, np.nan)
    for scan, row in enumerate(values):
        seen = np.sort(row[~np.isnan(row)])
        if len(seen) >= 2:
            subsets[scan] = seen[0], seen[-1]
        elif len(seen) == 1:
            subsets[scan, _subset_of(float(seen[0]), last, single)] = seen[0]
        last = np.where(np.isnan(subsets[scan]), last, subsets[scan])
    return subsets


def _subset_of(position_px: float, last_px: Array, single: Single) -> int:
    if single == "first" or np.isnan(last_px).any():
        return 0
    return int(np.argmin(np.abs(last_px - position_px)))
