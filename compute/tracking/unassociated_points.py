"""Points of peaks that no track explains."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.reconstruction.correspondence import (
    IntersectionPoints,
    MatchSettings,
    PredictedPoints,
    Predictor,
    SearchPart,
    group_peaks,
    intersection_points,
)
from compute.reconstruction.point_batch import PointBatch, PointFlag
from compute.signal.peaks import PeakFlag
from compute.tracking.measurements import Measurements

Array = NDArray[np.float64]
Solve = Callable[[Array, Array], PointBatch]

_NO_POINT = (
    PointFlag.TOO_FEW_SENSORS
    | PointFlag.DEGENERATE
    | PointFlag.NO_CONVERGENCE
    | PointFlag.INCONSISTENT
)


@dataclass(frozen=True, eq=False)
class UnassociatedPoints:
    """N points of left-over peaks.

    Args:
        position_mm: shape (N, 3).
        covariance_mm2: shape (N, 3, 3).
        peaks: index of each sensor's peak; -1: none, shape (N, S).
        sigma_px: standard deviations of these; NaN: none, shape (N, S).
        ambiguous: whether other points may explain the same peaks, shape (N,).
    """

    position_mm: Array
    covariance_mm2: Array
    peaks: NDArray[np.int32]
    sigma_px: Array
    ambiguous: NDArray[np.bool_]

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.position_mm)


@dataclass(frozen=True, eq=False)
class UnassociatedPointFinder:
    """Finds points of left-over peaks.

    Args:
        solve: readings to points.
        predict: the same sensors, forward.
        settings: of the grouping.
    """

    solve: Solve
    predict: Predictor
    settings: MatchSettings

    def find(
        self, peaks: Measurements, free: NDArray[np.bool_], expected: PredictedPoints
    ) -> UnassociatedPoints | None:
        """Return the points of the peaks that are free, shape (S, K); None where there are none.

        Args:
            peaks: of the frame.
            free: which of them to look at.
            expected: where markers are looked for: three sensors are enough there.
        """
        packed = _pack_columns(peaks, free)
        if packed is None:
            return None
        order, position, sigma, merged = packed
        groups = group_peaks(
            self.solve,
            position,
            sigma,
            predict=self.predict,
            merged=merged,
            predicted=expected if len(expected) else None,
            settings=self.settings,
        )
        if len(groups) == 0:
            return None
        points = self.solve(groups.readings_px, groups.sigma_px)
        good = np.isfinite(points.position_mm[:, 0]) & ((points.flags & _NO_POINT) == 0)
        if not good.any():
            return None
        place = groups.peaks[good]
        given = np.take_along_axis(order.T, np.maximum(place, 0), axis=0)
        return UnassociatedPoints(
            points.position_mm[good],
            points.covariance_mm2[good],
            np.where(place >= 0, given, -1).astype(np.int32),
            np.where(place >= 0, groups.sigma_px[good], np.nan),
            groups.ambiguous[good],
        )

    def intersections(
        self,
        peaks: Measurements,
        free: NDArray[np.bool_],
        part: SearchPart,
    ) -> tuple[IntersectionPoints, float]:
        """Return all points, ghosts with them, where free peaks meet; see ``intersection_points``."""
        there = free & peaks.can_initiate
        position = np.where(there, peaks.position_px, np.nan)
        sigma = np.where(there, np.sqrt(peaks.variance_px2), np.nan)
        merged = (peaks.flags & PeakFlag.MERGED) != 0
        return intersection_points(
            self.solve, self.predict, position, sigma, merged, part, self.settings
        )


def _pack_columns(
    peaks: Measurements, free: NDArray[np.bool_]
) -> tuple[NDArray[np.intp], Array, Array, NDArray[np.bool_]] | None:
    """Return free peaks side by side from the first column on: indices, places, sigma, merged."""
    free = free & peaks.can_initiate
    counts = free.sum(axis=1)
    if (counts > 0).sum() < 3:
        return None
    order = np.argsort(~free, axis=1, kind="stable")[:, : int(counts.max())]
    packed = np.take_along_axis(free, order, axis=1)
    position = np.where(packed, np.take_along_axis(peaks.position_px, order, axis=1), np.nan)
    sigma = np.sqrt(np.take_along_axis(peaks.variance_px2, order, axis=1))
    flags = np.where(packed, np.take_along_axis(peaks.flags, order, axis=1), 0)
    return order, position, np.where(packed, sigma, np.nan), (flags & PeakFlag.MERGED) != 0
