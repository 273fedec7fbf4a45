"""Candidates: combinations of peaks that intersect, with their likelihoods."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from math import lgamma, log, pi

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurements import Measurements
from compute.reconstruction.correspondence.settings import FALSE_REJECTION, MatchSettings
from compute.reconstruction.point_batch import PointBatch
from compute.reconstruction.triangulation import chi2_limit

Array = NDArray[np.float64]
Choice = NDArray[np.intp]
Solve = Callable[[Array, Array], PointBatch]

MISFIT_BANDS = np.array([1.0, 3.0, 20.0])
"""Misfits of up to these times what a marker may have tell how many are there by chance."""
MAX_EXTENT_MM = 500.0
"""Largest standard deviation of a point: markers are not farther apart."""
PRIOR_EXTENT_MM = 5.0
"""Up to which a less determined point is taken as likelier. Markers that are evenly spread are
dense in readings where these tell little, far away; but nothing is known of a volume so far out."""
_HALF_COUNT = 0.5
_LOG_TWO_PI = log(2.0 * pi)


@dataclass(frozen=True, eq=False)
class Candidates:
    """C combinations of peaks with the points where they intersect.

    Args:
        choice: index of each sensor's peak, -1: none, shape (C, S).
        points: the C points where they meet.
        chi2: of the readings, and of the predicted point where there is one, shape (C,).
        dof: of freedom of ``chi2``, shape (C,).
        log_marginal: log of the integral of the readings' likelihood over space, shape (C,) [mm^3].
        log_marginal_capped: the same, but not larger for being less determined than
            ``PRIOR_EXTENT_MM``.
        predicted: index of the predicted point that it would be, -1: none, shape (C,).
        log_density: log of that point's density at the position, shape (C,) [1/mm^3]; 0: none.
    """

    choice: Choice
    points: PointBatch
    chi2: Array
    dof: NDArray[np.intp]
    log_marginal: Array
    log_marginal_capped: Array
    predicted: NDArray[np.intp]
    log_density: Array

    def __len__(self) -> int:
        """Return the number of combinations."""
        return len(self.choice)

    @property
    def position_mm(self) -> Array:
        """Positions, shape (C, 3) [mm]."""
        return self.points.position_mm

    @property
    def covariance_mm2(self) -> Array:
        """Covariances of the positions, shape (C, 3, 3) [mm^2]."""
        return self.points.covariance_mm2

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> "Candidates":
        """Return some of the combinations."""
        return Candidates(
            self.choice[index],
            self.points.take(index),
            self.chi2[index],
            self.dof[index],
            self.log_marginal[index],
            self.log_marginal_capped[index],
            self.predicted[index],
            self.log_density[index],
        )

    def concatenate(self, other: "Candidates") -> "Candidates":
        """Return these combinations and others after them."""
        if len(self) == 0:
            return other
        return Candidates(
            np.concatenate([self.choice, other.choice]),
            PointBatch.concatenate([self.points, other.points]),
            np.concatenate([self.chi2, other.chi2]),
            np.concatenate([self.dof, other.dof]),
            np.concatenate([self.log_marginal, other.log_marginal]),
            np.concatenate([self.log_marginal_capped, other.log_marginal_capped]),
            np.concatenate([self.predicted, other.predicted]),
            np.concatenate([self.log_density, other.log_density]),
        )

    def scores(self, settings: MatchSettings, missed: NDArray[np.intp]) -> Array:
        """Return log likelihood ratios to the peaks being false, shape (C,).

        Args:
            settings: the model of peaks.
            missed: how many sensors should have a peak of it and have none, shape (C,).
        """
        seen = (self.choice >= 0).sum(axis=1)
        # Were it not the predicted point, that would have been missed, by all sensors at once.
        tracked = self.log_density - settings.log_missed
        density = np.where(self.predicted < 0, log(settings.markers_per_mm3), tracked)
        score: Array = (
            density
            + self.log_marginal_capped
            + seen * settings.log_seen
            + missed * settings.log_missed
        )
        return score


@dataclass(frozen=True, eq=False)
class SolvedCombinations:
    """N reconstructed combinations.

    Args:
        candidates: those that meet.
        row: which they are, shape (C,).
        chi2: of all, NaN where there is no point, shape (N,).
        dof: of freedom of all, shape (N,).
    """

    candidates: Candidates
    row: NDArray[np.intp]
    chi2: Array
    dof: NDArray[np.intp]


def solve_combinations(solve: Solve, peaks: Measurements, choice: Choice) -> SolvedCombinations:
    """Reconstruct combinations of three or more peaks.

    Args:
        solve: triangulates readings.
        peaks: of the exposure.
        choice: index of each sensor's peak, -1: none, shape (N, S).
    """
    readings, sigma = peaks.readings(choice)
    points = solve(readings, sigma)
    dof = points.used.sum(axis=1) - 3
    with np.errstate(invalid="ignore"):
        good = np.flatnonzero(points.chi2 <= _limits(len(peaks))[np.maximum(dof, 0)])
    candidates = empty_candidates(len(peaks))
    if len(good):
        chi2, n_dof, covariance = points.chi2[good], dof[good], points.covariance_mm2[good]
        log_sigma = np.log(np.where(points.used[good], sigma[good], 1.0)).sum(axis=1)
        rest = -log_sigma - 0.5 * _LOG_TWO_PI * n_dof - 0.5 * chi2
        log_volume, compared = log_volumes(covariance)
        candidates = Candidates(
            choice[good],
            points.take(good),
            chi2,
            n_dof,
            log_volume + rest,
            compared + rest,
            np.full(len(good), -1),
            np.zeros(len(good)),
        )
    return SolvedCombinations(candidates, good, points.chi2, dof)


def log_volumes(covariance: Array) -> tuple[Array, Array]:
    """Return log of the root of ``det (C^-1 + 1 / e^2)^-1`` for both extents e, shape (C,)."""
    xx, yy, zz = covariance[:, 0, 0], covariance[:, 1, 1], covariance[:, 2, 2]
    xy, xz, yz = covariance[:, 0, 1], covariance[:, 0, 2], covariance[:, 1, 2]
    trace = xx + yy + zz
    minor = yy * zz - yz * yz
    minors = minor + xx * zz - xz * xz + xx * yy - xy * xy
    determinant = xx * minor - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    # Rounding may leave nothing of what is all but flat.
    determinant = np.maximum(determinant, 1e-30)
    one, other = (
        0.5 * np.log(determinant / (1.0 + x * (trace + x * (minors + x * determinant))))
        for x in (MAX_EXTENT_MM**-2, PRIOR_EXTENT_MM**-2)
    )
    return one, other


def _limit(n_dof: int) -> float:
    return chi2_limit(n_dof, FALSE_REJECTION)


@cache
def _limits(sensors: int) -> Array:
    """Return the limits of chi2 by degrees of freedom; infinity is beyond all of them."""
    return np.array([min(_limit(n_dof), 1e300) for n_dof in range(sensors - 2)])


@cache
def empty_candidates(sensors: int) -> Candidates:
    """Return no combinations."""
    none = np.empty(0)
    whole = np.empty(0, dtype=np.intp)
    return Candidates(
        np.empty((0, sensors), dtype=np.intp),
        PointBatch.empty(sensors),
        none,
        whole,
        none,
        none,
        whole,
        none,
    )


class MisfitDensity:
    """Density of wrong combinations' misfits about zero, as counted in this frame.

    Wrong combinations' misfits are uniform over a range wider than the noise: their number in a
    wide band gives their density near zero, where a marker's misfits lie. Where the noise is so
    wide that the broadest band reaches beyond all peaks, a narrower one is denser, and counts.
    """

    def __init__(self) -> None:
        self._hits = np.zeros(len(MISFIT_BANDS))
        self._width = np.zeros(len(MISFIT_BANDS))

    def add(self, hits: Array, width: Array) -> None:
        """Add counts of misfits.

        Args:
            hits: misfits within each of the B bands, shape (B,).
            width: widths of the bands, in standard deviations, shape (B,).
        """
        self._hits += hits
        self._width += width

    def log_density(self) -> float:
        """Return the log density of wrong misfits at zero, per standard deviation."""
        if self._width[-1] <= 0.0:
            return -np.inf
        # What is seen in a band for sure, and half a misfit in the broadest at least.
        sure = np.maximum(self._hits - np.sqrt(np.maximum(self._hits, 0.0)), 0.0)
        sure[-1] = max(self._hits[-1], 0.0) + _HALF_COUNT
        return float(np.log((sure / self._width).max()))

    def count(self, chi2: Array, dof: int, true: int) -> None:
        """Count the misfits of all combinations with the same degrees of freedom.

        Args:
            chi2: of each combination, shape (N,).
            dof: its degrees of freedom.
            true: how many of them may be markers.
        """
        limit = _limit(dof)
        # NaN, where there is no point, compares as false.
        hits = np.array([np.count_nonzero(chi2 <= band**2 * limit) - true for band in MISFIT_BANDS])
        # The share of a ball of so many dimensions, as the density along one of them.
        counted = np.maximum(hits, 0) + _HALF_COUNT
        share = counted / max(len(chi2), 1)
        self.add(hits, counted * np.exp((_log_ball_volumes(dof) - np.log(share)) / dof))


@cache
def _log_ball_volumes(dof: int) -> Array:
    """Return the log volumes of the bands as balls in ``dof`` dimensions, in deviations."""
    log_ball = 0.5 * dof * log(pi) - lgamma(0.5 * dof + 1.0)
    volumes: Array = log_ball + dof * (0.5 * log(_limit(dof)) + np.log(MISFIT_BANDS))
    return volumes
