"""Offered: what the readings of an exposure are off a tool, and whether many are too far off.

An error of the calibration is the same in all exposures. What single exposures are off by is right
on average over all calibrations; of one device it may be too much in every one. So squares of
several exposures are compared with what their errors have in common.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.reconstruction.points import chi2_limit

Array = NDArray[np.float64]

_LEAST: Final = 0.05
"""Variance of any combination of whitened readings, at least: below it rounding decides."""


@dataclass(frozen=True, eq=False)
class Offered:
    """What the readings that an exposure offered are off.

    Args:
        square: sum of their squares, those that were left out as well.
        count: how many readings.
        left_out: how many were left out of each marker, shape (M,).
        whitened: those that were not: the innovations, of unit covariance, and their slopes by the
            common errors, shape (n, 1 + E); None: what they share is not known.
    """

    square: float
    count: int
    left_out: NDArray[np.intp]
    whitened: Array | None = None

    @cached_property
    def leaves(self) -> bool:
        """Whether any was left out."""
        return bool(np.count_nonzero(self.left_out))


def judged(offered: Sequence[Offered], probability: float) -> tuple[float, int, float]:
    """Return the sum of the squares of some exposures, how many, and the most that it may be.

    Where the sum is too large for readings that err independently, and what they share is known,
    it is that of the readings whitened together.

    Args:
        offered: the exposures.
        probability: chance that right readings are taken for wrong ones.
    """
    square = sum(one.square for one in offered)
    count = sum(one.count for one in offered)
    limit = _limit(count, probability)
    if square > limit:
        known = [one.whitened for one in offered if one.whitened is not None]
        if known and known[0].shape[1] > 1:
            square = min(square, _together(square, known))
    return square, count, limit


_limit: Final = lru_cache(maxsize=1024)(chi2_limit)


def _together(square: float, whitened: Sequence[Array]) -> float:
    """Return the squares with the innovations of all exposures whitened as one."""
    value = np.concatenate([one[:, 0] for one in whitened])
    common = np.concatenate([one[:, 1:] for one in whitened])
    covariance = common @ common.T
    first = 0
    for one in whitened:
        own = slice(first, first + len(one))
        covariance[own, own] = np.eye(len(one))
        first += len(one)
    size, axes = np.linalg.eigh(covariance)
    alone = float(value @ value)
    along = axes.T @ value
    return square - alone + float((along**2 / np.maximum(size, _LEAST)).sum())
