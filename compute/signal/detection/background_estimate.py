"""Background level and noise of a scan, estimated from a few groups of its pixels.

A scan is sampled where the centroid finder samples it: up to 32 groups of 8 pixels. Each group
gives the sum of squares about its own straight line, which knows no background and no slope; the
lower half of the groups gives the variance, so that peaks may cover half of them.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.special import betainc
from scipy.stats import chi2

from compute.signal.centroid_settings import GROUP_PIXELS, LEVEL_UNIT, sample_starts

GROUP_DOF: Final = GROUP_PIXELS - 2
"""Degrees of freedom of a group's squares about its straight line."""

MIN_VARIANCE: Final = 1.0 / 3.0
"""Smallest variance of a pixel [counts^2]: noise of half a count, and the rounding to counts.

Fainter noise is sampled too coarsely to be measured: by where the level lies between two
counts, a scan's own figure is half or twice the truth."""

SQUARES_UNIT: Final = 168
"""Squares are whole numbers in units of 1/168 count^2: 8 and 168 = 7^2 + 5^2 + ... divide it."""


@dataclass(frozen=True, eq=False)
class BackgroundEstimate:
    """Background and noise of L scans, in whole numbers.

    Args:
        background: first quartile of the groups' means [1/64 count], int64, shape (L,).
        squares: sum of the lower half of the groups' squares about their straight lines
            [1/168 count^2], int64, shape (L,).
        groups: number of groups.
    """

    background: NDArray[np.int64]
    squares: NDArray[np.int64]
    groups: int

    def variance(self) -> NDArray[np.float64]:
        """Return the variance of a pixel [counts^2], shape (L,); MIN_VARIANCE at least.

        One multiplication by a constant, and the larger of two: the same on every device.
        """
        scale = 1.0 / (SQUARES_UNIT * lowest_squares_mean(self.groups, self.groups // 2))
        return np.maximum(self.squares.astype(np.float64) * scale, MIN_VARIANCE)


def estimate_background(scans: NDArray[np.uint16]) -> BackgroundEstimate:
    """Estimate background and noise of scans of shape (L, P), P at least 64.

    With n pixels v and places k = -7, -5, ..., 7 the squares about the straight line are
    ``sum v^2 - (sum v)^2 / 8 - (sum k v)^2 / 168``, times 168 a whole number below 2^43.

    For even noise, of 32 groups, the variance has a standard error of 14 %, the deviation of
    7 %: 1.8 times the variance of all groups' mean, the price of outliers that do not count. A
    tenth of the groups on peaks raises the deviation by 3 %, a quarter by 9 % (printed by
    tests/compute/signal/detection/test_background_estimate.py). Noise that is not independent from
    pixel to pixel is not seen as what it is.
    """
    starts = np.array(sample_starts(scans.shape[1]))
    groups = scans[:, starts[:, None] + np.arange(GROUP_PIXELS)].astype(np.int64)
    ramp = 2 * np.arange(GROUP_PIXELS) - (GROUP_PIXELS - 1)
    sums, moments = groups.sum(axis=2), groups @ ramp
    squares = (
        SQUARES_UNIT * (groups**2).sum(axis=2) - SQUARES_UNIT // GROUP_PIXELS * sums**2 - moments**2
    )
    count = len(starts)
    quartile = np.sort(sums, axis=1)[:, (count - 1) // 4]
    lower = np.sort(squares, axis=1)[:, : count // 2].sum(axis=1)
    return BackgroundEstimate(quartile * (LEVEL_UNIT // GROUP_PIXELS), lower, count)


@lru_cache(maxsize=256)
def lowest_squares_mean(groups: int, kept: int) -> float:
    """Return the mean of the sum of the lowest squares of groups of noise, for variance 1.

    Squares are chi-square; one of n is among the lowest m when fewer than m of the n - 1 others
    are below it.

    Args:
        groups: n.
        kept: m, fewer than n.
    """

    def share(value: float) -> float:
        below = float(chi2.cdf(value, GROUP_DOF))
        # P(binomial(n - 1, below) <= m - 1)
        lowest = float(betainc(groups - kept, kept, 1.0 - below))
        return value * float(chi2.pdf(value, GROUP_DOF)) * lowest

    return groups * float(quad(share, 0.0, 60.0, epsabs=1e-10, limit=200)[0])


@lru_cache(maxsize=64)
def variance_dof(groups: int) -> float:
    """Return the degrees of freedom of chi-square noise with the variance's standard error.

    By the influence function of a mean of the lower half, min(x, median), exact for many groups.
    """
    median = float(chi2.median(GROUP_DOF))

    def moment(power: int) -> float:
        below = quad(lambda x: x**power * chi2.pdf(x, GROUP_DOF), 0.0, median)[0]
        return float(below) + 0.5 * median**power

    variance = groups * (moment(2) - moment(1) ** 2)
    return 2.0 * lowest_squares_mean(groups, groups // 2) ** 2 / variance
