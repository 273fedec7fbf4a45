"""Point-to-point test: a known distance between two markers, measured at many positions."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter, TooFewPoints
from compute.quality.statistics import ErrorStatistics, error_statistics

Array = NDArray[np.float64]


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
    extent_mm: tuple[float, float, float]


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
    between = end - start
    length = np.linalg.norm(between, axis=1)
    along = between / length[:, None]
    variance = np.einsum("ni,nij,nj->n", along, start_covariance + end_covariance, along)
    errors = length - reference_mm
    centre = (start + end) / 2.0
    extent = np.ptp(centre, axis=0)
    return PointToPoint(
        reference_mm,
        error_statistics(errors),
        reference_sigma_mm,
        float((errors**2 / (variance + reference_sigma_mm**2)).mean()),
        (float(extent[0]), float(extent[1]), float(extent[2])),
    )


def _at(
    track: MarkerTrack, time_s: Array, max_gap_s: float
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Interpolate positions and covariances at some times; also where that was possible."""
    if len(track.time_s) == 0:
        nothing = np.zeros((len(time_s), 3))
        return nothing, np.zeros((len(time_s), 3, 3)), np.zeros(len(time_s), dtype=np.bool_)
    after = np.clip(np.searchsorted(track.time_s, time_s), 1, max(1, len(track.time_s) - 1))
    before = after - 1
    after = np.minimum(after, len(track.time_s) - 1)
    gap = track.time_s[after] - track.time_s[before]
    share = np.divide(time_s - track.time_s[before], gap, out=np.zeros(len(time_s)), where=gap > 0)
    exact = (time_s == track.time_s[before]) | (time_s == track.time_s[after])
    covered = exact | ((share >= 0.0) & (share <= 1.0) & (gap > 0) & (gap <= max_gap_s))
    weight = share[:, None]
    position = (1 - weight) * track.position_mm[before] + weight * track.position_mm[after]
    square = weight[..., None] ** 2
    covariance = (1 - weight[..., None]) ** 2 * track.covariance_mm2[before]
    covariance = covariance + square * track.covariance_mm2[after]
    return position, covariance, covered
