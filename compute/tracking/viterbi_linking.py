"""ViterbiLinker: points of several exposures linked to the most probable sequences."""

from collections import deque
from dataclasses import dataclass
from math import inf, log
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurements import Measurements
from compute.reconstruction.correspondence.intersections import IntersectionPoints, SearchPart
from compute.reconstruction.triangulation import chi2_limit
from compute.tracking.settings import TrackerSettings
from compute.tracking.unassociated_points import UnassociatedPointFinder

Array = NDArray[np.float64]

MIN_POINTS: Final = 3
"""Number of points of a sequence: the third rarely fits the velocity of two by chance."""
FIRST_GAP: Final = 2
"""Exposures from the first point of a sequence to the second one, which tells its velocity."""
MAX_GAP: Final = 4
"""Exposures from any other point to the next."""
LINK_EXCLUSION_PROBABILITY: Final = 1e-4
"""Probability that a marker's next point lies outside the gate."""
MISSED_EXPOSURE_LOG_PENALTY: Final = log(0.5)
"""Change of a sequence's log likelihood by an exposure without a point of it."""
_WINDOW: Final = FIRST_GAP + (MIN_POINTS - 2) * MAX_GAP + 1
_MOVING: Final = 6
_NONE: Final = -1


@dataclass(frozen=True, eq=False)
class _Layer:
    """The points of one exposure, each the end of the most probable sequence that leads to it.

    Args:
        points: N of them.
        time_ns: of the exposure.
        number: of the exposure.
        mean: position and velocity at each, by its sequence, shape (N, 6).
        covariance: shape (N, 6, 6).
        score: log likelihood ratio of the sequence to no one's peaks, shape (N,).
        length: points of the sequence, shape (N,).
        before: number of the exposure of the point before, and its row; -1: none, shape (N, 2).
    """

    points: IntersectionPoints
    time_ns: int
    number: int
    mean: Array
    covariance: Array
    score: Array
    length: NDArray[np.intp]
    before: NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class PointSequence:
    """Sequence of points that may be one marker, the oldest first.

    Args:
        time_ns: of each, L of them.
        points: the points.
    """

    time_ns: tuple[int, ...]
    points: IntersectionPoints


class ViterbiLinker:
    """Links the points of exposures in which most are ghosts.

    In an exposure of N markers on four sensors, N^4 combinations of peaks meet by chance here and
    there. Ghosts of markers that move differ from exposure to exposure, markers go on. Each point
    is linked to the sequence before it of highest probability: Viterbi's algorithm, with a filter
    of constant velocity along each sequence (G. D. Forney, 10.1109/PROC.1973.9030).

    Args:
        settings: of the tracker.
        finder: of points in one exposure.
    """

    def __init__(self, settings: TrackerSettings, finder: UnassociatedPointFinder) -> None:
        self._settings, self._finder = settings, finder
        self._layers: deque[_Layer] = deque(maxlen=_WINDOW)
        self._number = 0
        self._first_px = self._following_px = -inf

    def forget(self) -> None:
        """Delete all sequences; continue with the next part of the combinations."""
        self._layers.clear()
        self._first_px = self._following_px

    def find(
        self, time_ns: int, peaks: Measurements, free: NDArray[np.bool_]
    ) -> list[PointSequence]:
        """Return the sequences that end in this exposure, the most probable first.

        Args:
            time_ns: of the exposure, later than the last one's.
            peaks: of the exposure.
            free: peaks that are no track's, shape (S, K).
        """
        self._number += 1
        points, self._following_px = self._finder.intersections(
            peaks, free, SearchPart(self._number, self._first_px)
        )
        layer = self._link(points, time_ns)
        self._layers.append(layer)
        rows = np.flatnonzero((layer.length >= MIN_POINTS) & (layer.score > 0.0))
        return [self._path(row) for row in rows[np.argsort(-layer.score[rows], kind="stable")]]

    def _link(self, points: IntersectionPoints, time_ns: int) -> _Layer:
        """Return the points of an exposure, each with the most probable sequence up to it."""
        count = len(points)
        speeds = np.arange(3, _MOVING)
        mean = np.zeros((count, _MOVING))
        mean[:, :3] = points.position_mm
        covariance = np.zeros((count, _MOVING, _MOVING))
        covariance[:, :3, :3] = points.covariance_mm2
        covariance[:, speeds, speeds] = self._settings.start_speed_mm_s**2
        score = points.log_ratio_with_prior.copy()
        length = np.ones(count, dtype=np.intp)
        before = np.full((count, 2), _NONE)
        limit = chi2_limit(3, LINK_EXCLUSION_PROBABILITY)
        distance_limit = np.sqrt(limit * np.trace(points.covariance_mm2, axis1=1, axis2=2))
        for layer in self._layers:
            gap = self._number - layer.number
            if gap > MAX_GAP or len(layer.points) == 0 or count == 0:
                continue
            rows = np.flatnonzero(layer.length > (gap > FIRST_GAP))
            if len(rows) == 0:
                continue
            ahead, predicted_covariance = self._extrapolate(
                layer, rows, (time_ns - layer.time_ns) * 1e-9
            )
            # First by the largest deviation there is: cheap, and leaves few.
            reach = np.sqrt(limit * np.trace(predicted_covariance[:, :3, :3], axis1=1, axis2=2))
            apart = ((ahead[:, None, :3] - points.position_mm[None]) ** 2).sum(axis=2)
            one, two = np.nonzero(apart <= (reach[:, None] + distance_limit[None]) ** 2)
            off = points.position_mm[two] - ahead[one, :3]
            total = predicted_covariance[one][:, :3, :3] + points.covariance_mm2[two]
            inverse = np.linalg.inv(total)
            squared = np.einsum("ni,nij,nj->n", off, inverse, off)
            density = -0.5 * (squared + np.linalg.slogdet(total)[1] + 3.0 * log(2.0 * np.pi))
            value = (
                layer.score[rows[one]]
                + points.log_ratio[two]
                + density
                + (gap - 1) * MISSED_EXPOSURE_LOG_PENALTY
            )
            value[squared > limit] = -inf
            best = np.full(count, -inf)
            np.maximum.at(best, two, value)
            link = np.flatnonzero((value == best[two]) & (value > score[two]))
            at, first = np.unique(two[link], return_index=True)
            link = link[first]
            source = one[link]
            gain = predicted_covariance[source][:, :, :3] @ inverse[link]
            mean[at] = ahead[source] + (gain @ off[link][..., None])[..., 0]
            covariance[at] = (
                predicted_covariance[source] - gain @ predicted_covariance[source][:, :3]
            )
            score[at] = value[link]
            length[at] = layer.length[rows[source]] + 1
            before[at, 0], before[at, 1] = layer.number, rows[source]
        return _Layer(points, time_ns, self._number, mean, covariance, score, length, before)

    def _extrapolate(
        self, layer: _Layer, rows: NDArray[np.intp], step_s: float
    ) -> tuple[Array, Array]:
        """Return positions and velocities (N, 6) after a time, with an acceleration not known."""
        transition = np.eye(_MOVING)
        transition[:3, 3:] = step_s * np.eye(3)
        by = np.concatenate([0.5 * step_s**2 * np.eye(3), step_s * np.eye(3)])
        noise = self._settings.start_acceleration_mm_s2**2 * (by @ by.T)
        predicted_covariance = transition @ layer.covariance[rows] @ transition.T + noise
        return layer.mean[rows] @ transition.T, predicted_covariance

    def _path(self, row: int) -> PointSequence:
        by_number = {layer.number: layer for layer in self._layers}
        number, at = self._number, int(row)
        path = []
        while number in by_number:
            layer = by_number[number]
            path.append((layer.time_ns, layer.points.part(at, at + 1)))
            number, at = layer.before[at].tolist()
        times, points = zip(*reversed(path), strict=True)
        return PointSequence(times, IntersectionPoints.concatenate(points))
