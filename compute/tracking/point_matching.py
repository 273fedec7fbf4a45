"""Points of left-over peaks matched with tracks that are new or were lost."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from compute.reconstruction.points import chi2_limit
from compute.tracking.filtering import Innovation, joint_update
from compute.tracking.left_over import FoundPoints
from compute.tracking.motion_model import MotionModels
from compute.tracking.reading_model import Predicted, ReadingModel
from compute.tracking.settings import TrackerSettings
from compute.tracking.states import States, combined, weighed

Array = NDArray[np.float64]

MISSED_POINT = 1e-5
"""Chance that a track's own point lies outside its gate."""
_FAR = 1e12


def match_points(
    motion: MotionModels, states: States, points: FoundPoints
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return which of T tracks is seen at which of N points: rows of the one, of the other.

    The assignment with the least sum of squared Mahalanobis distances, within the gate.
    """
    if len(states) == 0:
        nobody = np.empty(0, dtype=np.intp)
        return nobody, nobody
    whole = combined(motion, states)
    off = points.position_mm[None] - whole.mean[:, None, :3]
    total = whole.covariance[:, None, :3, :3] + points.covariance_mm2[None]
    solved = np.linalg.solve(total, off[..., None])[..., 0]
    cost = (off * solved).sum(axis=2) + np.linalg.slogdet(total)[1]
    inside = (off * solved).sum(axis=2) <= chi2_limit(3, MISSED_POINT)
    rows, columns = linear_sum_assignment(np.where(inside, cost, _FAR))
    good = inside[rows, columns]
    return rows[good], columns[good]


@dataclass(frozen=True, eq=False)
class PointUpdate:
    """States of tracks after the readings of their points.

    Args:
        states: of T tracks.
        nis: shape (T,).
        evidence: log likelihood ratio of the readings to false peaks, missed ones with it, (T,).
        predicted: the readings of the points.
    """

    states: States
    nis: Array
    evidence: Array
    predicted: Predicted


def update_by_points(
    model: ReadingModel,
    settings: TrackerSettings,
    states: States,
    bias: Array,
    position_px: Array,
    variance_px2: Array,
    place_mm: Array,
) -> PointUpdate:
    """Update T tracks by the readings (T, S) of a point each; NaN where a sensor has none.

    The readings themselves are filtered; the point only says where to linearise.
    """
    used = np.isfinite(position_px)
    predicted = model.predict(place_mm)
    innovation = Innovation.of(used, predicted.slope, variance_px2, bias)
    apart = states.mean[..., :3] - place_mm[:, None]
    expected = predicted.reading_px[:, None] + np.einsum("tsi,tmi->tms", predicted.slope, apart)
    difference = np.where(used[:, None], position_px[:, None] - expected, 0.0)
    after, log, nis = joint_update(states, innovation, difference)
    top = log.max(axis=1)
    share = (states.probability * np.exp(log - top[:, None])).sum(axis=1)
    gain = np.log(settings.detection / settings.false_per_px)
    missed = (predicted.in_view & ~used).sum(axis=1)
    evidence = top + np.log(share) + used.sum(axis=1) * gain
    evidence += missed * np.log(1.0 - settings.detection)
    weighed(after, log)
    nis = (after.probability * nis).sum(axis=1)
    return PointUpdate(after, nis, evidence, predicted)
