"""Assignment of points from unassociated peaks to tentative and lost tracks."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from compute.measurement.measurement_model import MeasurementModel, PredictedMeasurements
from compute.reconstruction.triangulation import chi2_limit
from compute.tracking.measurement_update import Innovation, joint_update
from compute.tracking.motion_model import (
    ImmStates,
    MotionModels,
    combine_modes,
    update_mode_probabilities,
)
from compute.tracking.settings import TrackerSettings
from compute.tracking.unassociated_points import UnassociatedPoints

Array = NDArray[np.float64]

GATE_EXCLUSION_PROBABILITY = 1e-5
"""Chance that a track's own point lies outside its gate."""
_FAR = 1e12


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
    if len(states) == 0:
        nobody = np.empty(0, dtype=np.intp)
        return nobody, nobody
    whole = combine_modes(motion, states)
    off = points.position_mm[None] - whole.mean[:, None, :3]
    total = whole.covariance[:, None, :3, :3] + points.covariance_mm2[None]
    solved = np.linalg.solve(total, off[..., None])[..., 0]
    cost = (off * solved).sum(axis=2) + np.linalg.slogdet(total)[1]
    inside = (off * solved).sum(axis=2) <= chi2_limit(3, GATE_EXCLUSION_PROBABILITY)
    rows, columns = linear_sum_assignment(np.where(inside, cost, _FAR))
    good = inside[rows, columns]
    return rows[good], columns[good]


@dataclass(frozen=True, eq=False)
class PointUpdate:
    """ImmStates of tracks after the readings of their points.

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
    innovation = Innovation.of(used, predicted.jacobian_px_per_mm, variance_px2, bias)
    apart = states.mean[..., :3] - position_mm[:, None]
    expected = predicted.reading_px[:, None] + np.einsum(
        "tsi,tmi->tms", predicted.jacobian_px_per_mm, apart
    )
    difference = np.where(used[:, None], position_px[:, None] - expected, 0.0)
    after, log, nis = joint_update(states, innovation, difference)
    top = log.max(axis=1)
    share = (states.probability * np.exp(log - top[:, None])).sum(axis=1)
    gain = np.log(settings.detection_probability / settings.clutter_density_per_px)
    missed = (predicted.in_view & ~used).sum(axis=1)
    log_likelihood_ratio = top + np.log(share) + used.sum(axis=1) * gain
    log_likelihood_ratio += missed * np.log(1.0 - settings.detection_probability)
    update_mode_probabilities(after, log)
    nis = (after.probability * nis).sum(axis=1)
    return PointUpdate(after, nis, log_likelihood_ratio, predicted)
