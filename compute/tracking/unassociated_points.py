"""Points from peaks that no track explains, and their assignment to tentative and lost tracks."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from compute.measurement.measurement_model import MeasurementModel, PredictedMeasurements
from compute.measurement.measurements import Measurements
from compute.reconstruction.correspondence.candidates import MatchSettings
from compute.reconstruction.correspondence.grouping import group_peaks
from compute.reconstruction.correspondence.intersections import (
    IntersectionPoints,
    SearchPart,
    intersection_points,
)
from compute.reconstruction.correspondence.predicted_candidates import PredictedPoints
from compute.reconstruction.point_batch import Batch, PointBatch, PointFlag
from compute.reconstruction.triangulation import chi2_limit, squared_distances
from compute.tracking.measurement_update import log_evidence, update_by_readings
from compute.tracking.motion_model import (
    ImmStates,
    MotionModels,
    combine_modes,
    update_mode_probabilities,
)
from compute.tracking.settings import TrackerSettings

Array = NDArray[np.float64]
Solve = Callable[[Array, Array], PointBatch]

_NO_POINT = (
    PointFlag.TOO_FEW_SENSORS
    | PointFlag.DEGENERATE
    | PointFlag.NO_CONVERGENCE
    | PointFlag.INCONSISTENT
)


GATE_EXCLUSION_PROBABILITY = 1e-5
"""Probability that a track's own point lies outside its gate."""
_FAR = 1e12


@dataclass(frozen=True, eq=False)
class UnassociatedPoints(Batch):
    """N points from unassociated peaks.

    Args:
        position_mm: shape (N, 3).
        covariance_mm2: shape (N, 3, 3).
        peaks: index of each sensor's peak; -1: none, shape (N, S).
        sigma_px: standard deviations of these; NaN: none, shape (N, S).
        ambiguous: whether other points may explain the same peaks, shape (N,).
    """

    position_mm: Annotated[Array, 3]
    covariance_mm2: Annotated[Array, 3, 3]
    peaks: Annotated[NDArray[np.int32], "S"]
    sigma_px: Annotated[Array, "S"]
    ambiguous: NDArray[np.bool_]


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
            expected: where markers are predicted: three sensors are enough there.
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


def assign_points(
    motion: MotionModels, states: ImmStates, points: UnassociatedPoints
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Assign points to tracks, each to one at most.

    The most likely assignment: the least sum of squared Mahalanobis distances and log determinants
    of their covariances, within the gate.

    Args:
        motion: M motion models.
        states: of T tracks, predicted to the time of the points.
        points: N points.

    Returns:
        Rows of the assigned tracks, and of the points assigned to them.
    """
    combined = combine_modes(motion, states)
    off = points.position_mm[None] - combined.mean[:, None, :3]
    total = combined.covariance[:, None, :3, :3] + points.covariance_mm2[None]
    squared = squared_distances(off, total)
    cost = squared + np.linalg.slogdet(total)[1]
    inside = squared <= chi2_limit(3, GATE_EXCLUSION_PROBABILITY)
    rows, columns = linear_sum_assignment(np.where(inside, cost, _FAR))
    good = inside[rows, columns]
    return rows[good], columns[good]


@dataclass(frozen=True, eq=False)
class PointUpdate:
    """States of tracks after the readings of their points.

    Args:
        states: of T tracks.
        nis: shape (T,).
        log_likelihood_ratio: log likelihood ratio of the readings to false peaks, missed ones with
            it, (T,).
        predicted: the readings of the points.
    """

    states: ImmStates
    nis: Array
    log_likelihood_ratio: Array
    predicted: PredictedMeasurements


def update_with_points(
    model: MeasurementModel,
    settings: TrackerSettings,
    states: ImmStates,
    bias: Array,
    position_px: Array,
    variance_px2: Array,
    position_mm: Array,
) -> PointUpdate:
    """Update T tracks by the readings of one point each.

    The readings themselves are filtered; the point only says where to linearise.

    Args:
        model: the measurement model, of S sensors.
        settings: detection probability and clutter density.
        states: of T tracks, predicted.
        bias: covariance of the readings' constant errors, shape (T, S, S) [px^2].
        position_px: readings, shape (T, S) [px]; NaN where a sensor has none.
        variance_px2: their variances, shape (T, S) [px^2].
        position_mm: the points, shape (T, 3) [mm].
    """
    used = np.isfinite(position_px)
    predicted = model.predict(position_mm)
    after, log, nis = update_by_readings(
        states, predicted, position_mm, used, position_px, variance_px2, bias
    )
    gain = np.log(settings.detection_probability / settings.clutter_density_per_px)
    missed = (predicted.in_view & ~used).sum(axis=1)
    log_likelihood_ratio = log_evidence(states.probability, log) + used.sum(axis=1) * gain
    log_likelihood_ratio += missed * np.log(1.0 - settings.detection_probability)
    update_mode_probabilities(after, log)
    nis = (after.probability * nis).sum(axis=1)
    return PointUpdate(after, nis, log_likelihood_ratio, predicted)
