"""ExposureResiduals: residuals of recent exposures and a chi-square consistency test.

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

from compute.reconstruction.triangulation import chi2_limit

Array = NDArray[np.float64]

_MIN_VARIANCE: Final = 0.05
"""Variance of any combination of whitened readings, at least: below it rounding decides."""


@dataclass(frozen=True, eq=False)
class ExposureResiduals:
    """What the readings that an exposure offered are off.

    Args:
        sum_of_squares: sum of their squares, those that were left out as well.
        count: how many readings.
        excluded: how many were left out of each marker, shape (M,).
        whitened: those that were not: the innovations, of unit covariance, and their slopes by the
            common errors, shape (n, 1 + E); None: what they share is not known.
    """

    sum_of_squares: float
    count: int
    excluded: NDArray[np.intp]
    whitened: Array | None = None

    @cached_property
    def any_excluded(self) -> bool:
        """Whether any was left out."""
        return bool(np.count_nonzero(self.excluded))


def chi2_test(
    exposures: Sequence[ExposureResiduals], probability: float
) -> tuple[float, int, float]:
    """Return the sum of the squares of some exposures, how many, and the most that it may be.

    Where the sum is too large for readings that err independently, and what they share is known,
    it is that of the readings whitened together.

    Args:
        exposures: the exposures.
        probability: chance that right readings are taken for wrong ones.
    """
    sum_of_squares = sum(one.sum_of_squares for one in exposures)
    count = sum(one.count for one in exposures)
    limit = _limit(count, probability)
    if sum_of_squares > limit:
        known = [one.whitened for one in exposures if one.whitened is not None]
        if known and known[0].shape[1] > 1:
            sum_of_squares = min(sum_of_squares, _jointly_whitened(sum_of_squares, known))
    return sum_of_squares, count, limit


_limit: Final = lru_cache(maxsize=1024)(chi2_limit)


def _jointly_whitened(sum_of_squares: float, whitened: Sequence[Array]) -> float:
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
    return sum_of_squares - alone + float((along**2 / np.maximum(size, _MIN_VARIANCE)).sum())
