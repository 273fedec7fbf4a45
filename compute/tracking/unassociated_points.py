"""Points from peaks that no track explains."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements
from compute.reconstruction.correspondence.candidates import MatchSettings
from compute.reconstruction.correspondence.grouping import group_peaks
from compute.reconstruction.correspondence.intersections import (
    IntersectionPoints,
    SearchPart,
    intersection_points,
)
from compute.reconstruction.correspondence.predicted_candidates import PredictedPoints
from compute.reconstruction.point_batch import PointBatch, PointFlag

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
    """N points from unassociated peaks.

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
    """Reconstructs points from unassociated peaks.

    Args:
        solve: readings to points.
        model: the measurement model.
        settings: of the grouping.
    """

    solve: Solve
    model: MeasurementModel
    settings: MatchSettings

    def find(
        self, peaks: Measurements, free: NDArray[np.bool_], expected: PredictedPoints
    ) -> UnassociatedPoints | None:
        """Return the points of free peaks; None where there are none.

        Args:
            peaks: of the frame.
            free: which of them to look at.
            expected: where markers are looked for: three sensors are enough there.
        """
        starting = peaks.only(free & peaks.can_initiate)
        if np.count_nonzero(starting.count) < 3:
            return None
        groups = group_peaks(
            self.solve,
            starting,
            model=self.model,
            predicted=expected if len(expected) else None,
            settings=self.settings,
        )
        if len(groups) == 0:
            return None
        points = groups.points
        good = np.isfinite(points.position_mm[:, 0]) & ((points.flags & _NO_POINT) == 0)
        if not good.any():
            return None
        chosen = groups.peaks[good]
        return UnassociatedPoints(
            points.position_mm[good],
            points.covariance_mm2[good],
            chosen.astype(np.int32),
            np.where(chosen >= 0, groups.sigma_px[good], np.nan),
            groups.ambiguous[good],
        )

    def intersections(
        self,
        peaks: Measurements,
        free: NDArray[np.bool_],
        part: SearchPart,
    ) -> tuple[IntersectionPoints, float]:
        """Return all intersections of free peaks, ghosts included.

        Args:
            peaks: measurements of the exposure, up to K peaks of each of S sensors.
            free: peaks that may be used, shape (S, K).
            part: part of the search that this exposure does.

        Returns:
            The points, and the first reading of the next part; minus infinity: all were tried.
        """
        starting = peaks.only(free & peaks.can_initiate)
        return intersection_points(self.solve, self.model, starting, part, self.settings)
