"""Accuracy tests of ASTM F2554: a stationary marker, and a known distance at many positions."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import Vector3
from compute.errors import InvalidParameter, TooFewPoints

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ErrorStatistics:
    """Summary of N errors [mm], with the values that ASTM F2554 requires.

    Args:
        count: N.
        mean: mean, with the errors' signs.
        standard_deviation: about the mean, N - 1 degrees of freedom.
        rms: root of the mean square.
        percentile_95: below which 95 % of the magnitudes lie.
        largest: the largest magnitude.
    """

    count: int
    mean: float
    standard_deviation: float
    rms: float
    percentile_95: float
    largest: float


def error_statistics(errors_mm: Array) -> ErrorStatistics:
    """Summarise errors.

    Args:
        errors_mm: with their sign where they have one [mm], shape (N,).

    Raises:
        TooFewPoints: fewer than two.
    """
    if len(errors_mm) < 2:
        raise TooFewPoints(
            f"{len(errors_mm)} values were measured; at least 2 say how much they scatter",
            count=len(errors_mm),
        )
    magnitudes = np.abs(errors_mm)
    return ErrorStatistics(
        len(errors_mm),
        float(errors_mm.mean()),
        float(errors_mm.std(ddof=1)),
        float(np.sqrt((errors_mm**2).mean())),
        float(np.percentile(magnitudes, 95.0)),
        float(magnitudes.max()),
    )


@dataclass(frozen=True)
class SinglePoint:
    """Precision of a stationary marker.

    Args:
        position_mm: mean position [mm].
        scatter: distances from the mean [mm].
        axes_mm: standard deviation along X, Y and Z [mm].
        stated_mm: root of the mean squared distance expected from the points' own covariances, an
            upper limit as these include errors common to all points [mm].
        drift_mm_per_min: speed of the straight line through the positions [mm/min].
        drift_sigma_mm_per_min: its standard deviation, from the scatter.
        bias: the mean's distance from the reference [mm]; None without one.
    """

    position_mm: Vector3
    scatter: ErrorStatistics
    axes_mm: Vector3
    stated_mm: float
    drift_mm_per_min: float
    drift_sigma_mm_per_min: float
    bias: float | None


def single_point(
    position_mm: Array,
    covariance_mm2: Array,
    time_s: Array,
    reference_mm: Array | None = None,
) -> SinglePoint:
    """Measure the precision of a stationary marker; the single-point test of ASTM F2554.

    The covariances include the calibration's, whose error is the same in each point and does not
    appear in the scatter: ``stated_mm`` is an upper limit of the scatter.

    Args:
        position_mm: N positions of the marker, shape (N, 3) [mm].
        covariance_mm2: theirs, shape (N, 3, 3) [mm^2].
        time_s: when each was measured, shape (N,) [s].
        reference_mm: where it is, shape (3,) [mm]; None: not known.

    Raises:
        TooFewPoints: fewer than three points.
        InvalidParameter: a value is not finite, or all times are the same.
    """
    if len(position_mm) < 3:
        raise TooFewPoints(
            f"the marker was measured {len(position_mm)} times; at least 3 are needed: is it in "
            "view?",
            count=len(position_mm),
        )
    if not (np.isfinite(position_mm).all() and np.isfinite(covariance_mm2).all()):
        raise InvalidParameter("a position or covariance is not a number; leave such points out")
    mean = position_mm.mean(axis=0)
    deviations = position_mm - mean
    scatter = error_statistics(np.linalg.norm(deviations, axis=1))
    speed, sigma = _drift(deviations, time_s)
    variances = np.einsum("nii->n", covariance_mm2)
    return SinglePoint(
        tuple(mean.tolist()),
        scatter,
        tuple(deviations.std(axis=0, ddof=1).tolist()),
        float(np.sqrt(variances.mean())),
        60.0 * speed,
        60.0 * sigma,
        None if reference_mm is None else float(np.linalg.norm(mean - reference_mm)),
    )


def _drift(deviations: Array, time_s: Array) -> tuple[float, float]:
    """Return the speed of the linear fit to the points and its standard deviation [mm/s].

    Raises:
        InvalidParameter: all times are the same.
    """
    since = time_s - time_s.mean()
    lever = float((since**2).sum())
    if lever == 0.0:
        raise InvalidParameter("all positions have the same time")
    velocity = since @ deviations / lever
    residual = deviations - since[:, None] * velocity
    variance = (residual**2).sum() / (len(deviations) - 2) / lever
    return float(np.linalg.norm(velocity)), float(np.sqrt(variance))


@dataclass(frozen=True, eq=False)
class MarkerTrack:
    """A marker's measured positions over time.

    Args:
        time_s: ascending, shape (N,) [s].
        position_mm: shape (N, 3) [mm].
        covariance_mm2: shape (N, 3, 3) [mm^2].
    """

    time_s: Array
    position_mm: Array
    covariance_mm2: Array


@dataclass(frozen=True)
class PointToPoint:
    """Accuracy of a measured distance.

    Args:
        reference_mm: the known distance [mm].
        errors: measured minus known [mm].
        mean_sigma_mm: standard deviation of the mean error due to the reference's uncertainty; the
            scatter contributes ``errors.standard_deviation`` over the root of the count, where the
            positions are independent.
        normalised_square: mean of the squared errors over their variances from the points'
            covariances; about 1 where these are right. Errors common to both ends, such as the
            calibration's, are treated as independent, which makes it smaller.
        extent_mm: extent of the midpoints along X, Y and Z [mm]: the volume tested.
    """

    reference_mm: float
    errors: ErrorStatistics
    mean_sigma_mm: float
    normalised_square: float
    extent_mm: Vector3


def point_to_point(
    first: MarkerTrack,
    second: MarkerTrack,
    reference_mm: float,
    reference_sigma_mm: float = 0.0,
    *,
    max_gap_s: float = np.inf,
) -> PointToPoint:
    """Measure the accuracy of a known distance; the point-to-point test of ASTM F2554.

    Markers that are lit in turn are never seen at the same time: the first marker's positions are
    interpolated linearly at the second's times.

    Args:
        first: a marker at one end.
        second: the marker at the other.
        reference_mm: their distance [mm].
        reference_sigma_mm: its standard deviation [mm].
        max_gap_s: over which no position is interpolated [s].

    Raises:
        InvalidParameter: the distance is not positive, or its standard deviation negative.
        TooFewPoints: fewer than two positions at which both were measured.
    """
    if not (0.0 < reference_mm < np.inf and 0.0 <= reference_sigma_mm < np.inf):
        raise InvalidParameter(
            f"the reference distance is {reference_mm} +- {reference_sigma_mm} mm; it must be "
            "positive, and its standard deviation zero or more"
        )
    start, start_covariance, covered = _at(first, second.time_s, max_gap_s)
    if covered.sum() < 2:
        raise TooFewPoints(
            f"both markers were measured together at {covered.sum()} positions; at least 2 are "
            "needed: are both in view?",
            count=int(covered.sum()),
        )
    start, start_covariance = start[covered], start_covariance[covered]
    end, end_covariance = second.position_mm[covered], second.covariance_mm2[covered]
    length = np.linalg.norm(end - start, axis=1)
    along = (end - start) / length[:, None]
    variance = np.einsum("ni,nij,nj->n", along, start_covariance + end_covariance, along)
    errors = length - reference_mm
    return PointToPoint(
        reference_mm,
        error_statistics(errors),
        reference_sigma_mm,
        float((errors**2 / (variance + reference_sigma_mm**2)).mean()),
        tuple(np.ptp((start + end) / 2.0, axis=0).tolist()),
    )


def _at(
    track: MarkerTrack, time_s: Array, max_gap_s: float
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Interpolate positions and covariances at some times; also where that was possible."""
    count = len(time_s)
    if len(track.time_s) == 0:
        return np.zeros((count, 3)), np.zeros((count, 3, 3)), np.zeros(count, dtype=np.bool_)
    after = np.clip(np.searchsorted(track.time_s, time_s), 1, max(1, len(track.time_s) - 1))
    before = after - 1
    after = np.minimum(after, len(track.time_s) - 1)
    gap = track.time_s[after] - track.time_s[before]
    share = np.divide(time_s - track.time_s[before], gap, out=np.zeros(count), where=gap > 0)
    exact = (time_s == track.time_s[before]) | (time_s == track.time_s[after])
    covered = exact | ((share >= 0.0) & (share <= 1.0) & (gap > 0) & (gap <= max_gap_s))
    weight = share[:, None]
    position = (1 - weight) * track.position_mm[before] + weight * track.position_mm[after]
    weight = weight[..., None]
    covariance = (1 - weight) ** 2 * track.covariance_mm2[before]
    return position, covariance + weight**2 * track.covariance_mm2[after], covered
