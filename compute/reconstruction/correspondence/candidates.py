"""Candidates: combinations of peaks that intersect, and their likelihood by MatchSettings."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from math import lgamma, log, pi
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.measurement.measurements import Measurements
from compute.reconstruction.point_batch import Batch, PointBatch
from compute.reconstruction.triangulation import chi2_limit

Array = NDArray[np.float64]
Choice = NDArray[np.intp]
Solve = Callable[[Array, Array], PointBatch]

FALSE_REJECTION = 1e-6
"""Probability that the peaks of one marker are not grouped."""
MISFIT_BANDS = np.array([1.0, 3.0, 20.0])
"""Misfits of up to these times what a marker may have tell how many are there by chance."""
MAX_EXTENT_MM = 500.0
"""Largest standard deviation of a point: markers are not farther apart."""
PRIOR_EXTENT_MM = 5.0
"""Up to which a less determined point is taken as likelier. Markers that are evenly spread are
dense in readings where these tell little, far away; but nothing is known of a volume so far out."""
_HALF_COUNT = 0.5
_MIN_LOG_RATIO = -100.0
_UNSEEN = 0.25
"""Unexplained peaks of a sensor that are expected beside those that are there, and for each
marker as many more as it has chances to be missed."""
_LOG_TWO_PI = log(2.0 * pi)


@dataclass(frozen=True)
class MatchSettings:
    """Model of peaks and markers, accepted error rate, and limits of the search.

    The first three need only the right order of magnitude: they cancel where two markers exchange
    peaks, and the density of chance intersections is measured in the frame itself.

    Args:
        detection_probability: probability that a sensor has a peak of a marker.
        clutter_density_per_px: density of false peaks [1/px].
        markers_per_mm3: density of markers [1/mm^3].
        max_error_rate: largest error probability of a group that counts as unambiguous.
        max_points: most combinations that are reconstructed in a frame.
        max_hypotheses: most branches of the enumeration of sets of markers, for each cluster of
            linked peaks; beyond, error probabilities are bounded by linear programmes.

    Raises:
        InvalidParameter: a value out of its range.
    """

    detection_probability: float = 0.95
    clutter_density_per_px: float = 2e-4
    markers_per_mm3: float = 1e-7
    max_error_rate: float = 1e-3
    max_points: int = 200_000
    max_hypotheses: int = 1_000

    def __post_init__(self) -> None:
        for name in ("detection_probability", "max_error_rate"):
            value = getattr(self, name)
            if not 0.0 < value < 1.0:
                raise InvalidParameter(
                    f"{name} is {value}; it must lie between 0 and 1", **{name: value}
                )
        for name in (
            "clutter_density_per_px",
            "markers_per_mm3",
            "max_points",
            "max_hypotheses",
        ):
            value = getattr(self, name)
            if not 0.0 < value < float("inf"):
                raise InvalidParameter(f"{name} is {value}; it must be positive", **{name: value})

    @property
    def log_detected(self) -> float:
        """Log likelihood ratio of a detected marker's peak to a false peak [log px]."""
        return log(self.detection_probability) - log(self.clutter_density_per_px)

    @property
    def log_missed(self) -> float:
        """Log likelihood of a missed detection."""
        return log(1.0 - self.detection_probability)

    @property
    def window(self) -> float:
        """Log odds beyond which other sets of markers are not enumerated."""
        return 3.0 - log(self.max_error_rate)


@dataclass(frozen=True, eq=False)
class Candidates(Batch):
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

    choice: Annotated[Choice, "S"]
    points: PointBatch
    chi2: Array
    dof: NDArray[np.intp]
    log_marginal: Array
    log_marginal_capped: Array
    predicted: NDArray[np.intp]
    log_density: Array

    @property
    def position_mm(self) -> Array:
        """Positions, shape (C, 3) [mm]."""
        return self.points.position_mm

    @property
    def covariance_mm2(self) -> Array:
        """Covariances of the positions, shape (C, 3, 3) [mm^2]."""
        return self.points.covariance_mm2

    def scores(self, settings: MatchSettings, missed: NDArray[np.intp]) -> Array:
        """Return log likelihood ratios to the peaks being false, shape (C,).

        Args:
            settings: the model of peaks.
            missed: how many sensors should have a peak of it and have none, shape (C,).
        """
        detections = (self.choice >= 0).sum(axis=1)
        # Were it not the predicted point, that would have been missed, by all sensors at once.
        tracked = self.log_density - settings.log_missed
        density = np.where(self.predicted < 0, log(settings.markers_per_mm3), tracked)
        score: Array = (
            density
            + self.log_marginal_capped
            + detections * settings.log_detected
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
    if not len(good):
        return SolvedCombinations(Candidates.empty(len(peaks)), good, points.chi2, dof)
    chi2, n_dof, covariance = points.chi2[good], dof[good], points.covariance_mm2[good]
    log_sigma = np.log(np.where(points.used[good], sigma[good], 1.0)).sum(axis=1)
    rest = -log_sigma - 0.5 * _LOG_TWO_PI * n_dof - 0.5 * chi2
    log_volume, compared = log_volumes(covariance)
    candidates = Candidates(
        choice[good],
        points.rows(good),
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

    def log_ratio(self) -> float:
        """Return the log density of wrong misfits at zero over that of noise."""
        if self._width[-1] <= 0.0:
            # Nothing was tried, and the figure is not used.
            return _MIN_LOG_RATIO
        # What is seen in a band for sure, and half a misfit in the broadest at least.
        sure = np.maximum(self._hits - np.sqrt(np.maximum(self._hits, 0.0)), 0.0)
        sure[-1] = max(self._hits[-1], 0.0) + _HALF_COUNT
        return max(float(np.log((sure / self._width).max())) + 0.5 * _LOG_TWO_PI, _MIN_LOG_RATIO)

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


class UnexplainedPeaks:
    """Peaks of an exposure that its most probable set of markers does not explain.

    Attributes:
        expected: expected number of them on each sensor, shape (S,).
        density_per_px: how dense they are over where the peaks lie, shape (S,) [1/px].

    Args:
        peaks: of the exposure, sorted.
        settings: the model of peaks.
        unassigned: number of peaks of each sensor that the set leaves, shape (S,).
        markers: number of markers in the set.
    """

    def __init__(
        self, peaks: Measurements, settings: MatchSettings, unassigned: Array, markers: int
    ) -> None:
        missed = markers * (1.0 - settings.detection_probability)
        self.expected: Array = np.maximum(unassigned, 0.0) + (_UNSEEN + missed)
        position_px, count = peaks.position_px, peaks.count
        last = position_px[np.arange(len(position_px)), np.maximum(count - 1, 0)]
        with np.errstate(divide="ignore", invalid="ignore"):
            density = self.expected * (count - 1) / ((last - position_px[:, 0]) * (count + 1))
        self.density_per_px = np.where(count >= 3, density, settings.clutter_density_per_px)
