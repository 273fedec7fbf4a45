"""Candidates: combinations of peaks that meet in a point, and how likely each is a marker."""

from collections.abc import Callable
from dataclasses import dataclass
from math import lgamma, log, pi

import numpy as np
from numpy.typing import NDArray

from compute.reconstruction.correspondence.peaks import FramePeaks
from compute.reconstruction.correspondence.settings import FALSE_REJECTION, MatchSettings
from compute.reconstruction.estimate import PointBatch
from compute.reconstruction.points import chi2_limit

Array = NDArray[np.float64]
Choice = NDArray[np.intp]
Solve = Callable[[Array, Array], PointBatch]

BAND = 20.0
"""Misfits of up to this times what a marker may have tell how many are there by chance."""
_HALF_COUNT = 0.5
_LOG_TWO_PI = log(2.0 * pi)


@dataclass(frozen=True, eq=False)
class Candidates:
    """C combinations.

    Args:
        choice: index of each sensor's peak, -1: none, shape (C, S).
        position_mm: shape (C, 3) [mm].
        covariance_mm2: shape (C, 3, 3) [mm^2].
        chi2: of the readings, and of the predicted point where there is one, shape (C,).
        degrees: of freedom of ``chi2``, shape (C,).
        log_fit: log of the integral of the readings' likelihood over space, shape (C,) [mm^3].
        predicted: index of the predicted point that it would be, -1: none, shape (C,).
    """

    choice: Choice
    position_mm: Array
    covariance_mm2: Array
    chi2: Array
    degrees: NDArray[np.intp]
    log_fit: Array
    predicted: NDArray[np.intp]

    def __len__(self) -> int:
        """Return the number of combinations."""
        return len(self.choice)

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> "Candidates":
        """Return some of them."""
        return Candidates(
            self.choice[index],
            self.position_mm[index],
            self.covariance_mm2[index],
            self.chi2[index],
            self.degrees[index],
            self.log_fit[index],
            self.predicted[index],
        )

    def joined(self, other: "Candidates") -> "Candidates":
        """Return these and others."""
        return Candidates(
            np.concatenate([self.choice, other.choice]),
            np.concatenate([self.position_mm, other.position_mm]),
            np.concatenate([self.covariance_mm2, other.covariance_mm2]),
            np.concatenate([self.chi2, other.chi2]),
            np.concatenate([self.degrees, other.degrees]),
            np.concatenate([self.log_fit, other.log_fit]),
            np.concatenate([self.predicted, other.predicted]),
        )

    def scores(self, settings: MatchSettings, missed: NDArray[np.intp]) -> Array:
        """Return log likelihood ratios to these peaks being no one's, shape (C,).

        Args:
            settings: the model of peaks.
            missed: how many sensors should have a peak of it and have none, shape (C,).
        """
        seen = (self.choice >= 0).sum(axis=1)
        # A predicted point comes with a density of its own, which ``log_fit`` holds already.
        density = np.where(self.predicted < 0, log(settings.markers_per_mm3), 0.0)
        score: Array = (
            density + self.log_fit + seen * settings.log_seen + missed * settings.log_missed
        )
        return score


def solved(solve: Solve, peaks: FramePeaks, choice: Choice) -> tuple[Candidates, Array, Array]:
    """Reconstruct combinations (N, S) of three or more peaks and keep those that meet.

    Returns:
        The ones that meet; chi2 of all, shape (N,), infinite where there is no point; and their
        degrees of freedom, shape (N,).
    """
    readings, sigma = peaks.readings(choice)
    points = solve(readings, sigma)
    degrees = points.used.sum(axis=1) - 3
    chi2 = np.where(np.isfinite(points.chi2), points.chi2, np.inf)
    limits = np.array([_limit(freedom) for freedom in range(len(peaks) - 2)])
    good = np.flatnonzero((chi2 <= limits[np.maximum(degrees, 0)]) & np.isfinite(chi2))
    covariance = points.covariance_mm2[good]
    used = points.used[good]
    spread = np.log(np.where(used, sigma[good], 1.0)).sum(axis=1)
    log_fit = (
        0.5 * np.log(np.linalg.det(covariance))
        - spread
        - 0.5 * _LOG_TWO_PI * degrees[good]
        - 0.5 * chi2[good]
    )
    found = Candidates(
        choice[good],
        points.position_mm[good],
        covariance,
        chi2[good],
        degrees[good],
        log_fit,
        np.full(len(good), -1),
    )
    return found, chi2, degrees


def _limit(freedom: int) -> float:
    return chi2_limit(freedom, FALSE_REJECTION)


def no_candidates(sensors: int) -> Candidates:
    """Return none."""
    none = np.empty(0)
    whole = np.empty(0, dtype=np.intp)
    return Candidates(
        np.empty((0, sensors), dtype=np.intp),
        np.empty((0, 3)),
        np.empty((0, 3, 3)),
        none,
        whole,
        none,
        whole,
    )


@dataclass
class Chance:
    """How densely misfits of wrong combinations lie about zero, as counted in this frame.

    Wrong combinations' misfits are spread evenly over a range much wider than the noise: how many
    lie in a wide band tells how many lie near zero, where a marker's do.

    Args:
        hits: misfits in the bands, in units of their deviations.
        width: of the bands, summed over all that was tried.
    """

    hits: float = 0.0
    width: float = 0.0

    def log_density(self) -> float:
        """Log of the density of a wrong misfit at zero, by the deviation that it is measured in."""
        if self.width <= 0.0:
            return -np.inf
        return float(np.log((self.hits + _HALF_COUNT) / self.width))

    def count(self, chi2: Array, degrees: int) -> None:
        """Count combinations of so many degrees of freedom, all that there are."""
        limit = _limit(degrees)
        inside = (chi2 > limit) & (chi2 <= BAND**2 * limit)
        hits = np.count_nonzero(inside)
        # The share of a ball of so many dimensions, as the density along one of them.
        log_ball = 0.5 * degrees * log(pi) - lgamma(0.5 * degrees + 1.0)
        volume = log_ball + 0.5 * degrees * log(limit) + log(BAND**degrees - 1.0)
        density = np.exp((log((hits + _HALF_COUNT) / max(len(chi2), 1)) - volume) / degrees)
        self.hits += hits
        self.width += (hits + _HALF_COUNT) / density
