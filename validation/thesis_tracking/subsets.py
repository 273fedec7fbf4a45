"""Subsets of the positions of two targets in the order of their detection, section 6.1.2."""

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
    order = SubsetOrder(single)
    subsets = np.full((len(values), 2), np.nan)
    for scan, row in enumerate(values):
        for subset, point in enumerate(order.step(row)):
            if point >= 0:
                subsets[scan, subset] = row[point]
    return subsets


class SubsetOrder:
    """Puts the points of one scan after the other into the subsets: ``order_by_detection``.

    Args:
        single: where a lone point goes.
        last_px: the last point of each subset, NaN: none yet, (2,).

    Raises:
        InvalidParameter: an unknown way.
    """

    def __init__(self, single: Single = "nearest", last_px: Array | None = None) -> None:
        if single not in get_args(Single):
            raise InvalidParameter(
                f"single is {single!r}; it must be one of {get_args(Single)}", single=single
            )
        self._single = single
        self._last_px = np.full(2, np.nan) if last_px is None else np.array(last_px, np.float64)

    def step(self, position_px: Array) -> tuple[int, int]:
        """Return which point of the next scan (K,) each subset has; -1: none."""
        row = np.argsort(position_px, kind="stable")  # NaN is last
        seen = row[: int((~np.isnan(position_px)).sum())].tolist()
        chosen = [-1, -1]
        if len(seen) >= 2:
            chosen = [seen[0], seen[-1]]
        elif len(seen) == 1:
            chosen[self._subset_of(float(position_px[seen[0]]))] = seen[0]
        for subset, point in enumerate(chosen):
            if point >= 0:
                self._last_px[subset] = position_px[point]
        return chosen[0], chosen[1]

    def _subset_of(self, position_px: float) -> int:
        if self._single == "first" or np.isnan(self._last_px).any():
            return 0
        return int(np.argmin(np.abs(self._last_px - position_px)))
