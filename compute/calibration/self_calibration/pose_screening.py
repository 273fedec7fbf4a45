"""Poses that contradict their own readings, and the single reading that is to blame."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.normal_equations import AdjustmentState
from compute.calibration.bundle_adjustment.parameter_covariance import undetermined_poses
from compute.calibration.bundle_adjustment.pose_set import PoseSet
from compute.calibration.bundle_adjustment.resection import resect
from compute.calibration.self_calibration.initial_poses import InitialPoses, select_poses
from compute.camera.model import SensorModel
from compute.reconstruction.triangulation import chi2_limit

Array = NDArray[np.float64]

CONTRADICTION_PROBABILITY: Final = 1e-6
"""Chance that a good pose is taken for one that holds a wrong reading."""
WORSE_RATIO_THRESHOLD: Final = 10.0
"""Squared misfit over the median of all, in their degrees of freedom, that is no fault of the
cameras, as long as these are not known well."""
SINGLE_OUTLIER_RATIO_THRESHOLD: Final = 20.0
"""By how much chi2 must be lower without one reading than without any other for it to blame."""


@dataclass(frozen=True, eq=False)
class ScreenedPoses:
    """Poses fitted one by one to cameras that are held.

    Args:
        start: all of them.
        misfit: chi2 over degrees of freedom, shape (B,); 0 without any.
        good: those that agree with their readings, as far as the cameras allow.
    """

    start: InitialPoses
    misfit: Array
    good: NDArray[np.bool_]


def screen_poses(models: Sequence[SensorModel], start: InitialPoses) -> ScreenedPoses:
    """Fit the poses one by one and tell those that contradict their readings."""
    poses, chi2 = resect(models, start.poses)
    dof = poses.seen.sum(axis=(1, 2)) - poses.unknowns
    misfit = np.where(dof > 0, chi2 / np.maximum(dof, 1), 0.0)
    checked = misfit[dof > 0]
    usual = float(np.median(checked)) if len(checked) else 0.0
    limits = _limits(dof) / np.maximum(dof, 1)
    good = (misfit <= np.maximum(limits, WORSE_RATIO_THRESHOLD * usual)) & np.isfinite(chi2)
    return ScreenedPoses(InitialPoses(poses, start.pose_index), misfit, good)


def _limits(dof: NDArray[np.int_]) -> Array:
    return np.array([chi2_limit(int(one), CONTRADICTION_PROBABILITY) for one in dof])


def find_outlier_readings(
    models: Sequence[SensorModel], poses: PoseSet
) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Return for contradictory poses the one reading without which they agree, if there is one.

    Every reading is left out in turn. It is to blame if the rest agree, and do so clearly better
    than without any other reading; a pose with two wrong readings has none.

    Returns:
        Which poses have one, shape (N,), its marker and sensor, shape (N, 2), and by how many
        of its deviations it is off from where the rest puts it, shape (N,).
    """
    seen = poses.seen
    pose, marker, sensor = np.nonzero(seen)
    trials = select_poses(poses, pose)
    readings = trials.readings_px.copy()
    readings[np.arange(len(pose)), marker, sensor] = np.nan
    trials = replace(trials, readings_px=readings)
    fit = ~undetermined_poses(models, trials)
    chi2 = np.full(len(pose), np.inf)
    off = np.zeros(len(pose))
    if fit.any():
        fitted, chi2[fit] = resect(models, select_poses(trials, fit))
        where = (np.arange(len(fitted)), marker[fit], sensor[fit])
        whole = replace(fitted, readings_px=select_poses(poses, pose[fit]).readings_px)
        off[fit] = AdjustmentState(tuple(models), (whole,)).residuals()[0][where]
    found, places, sizes = [], [], []
    for number in range(len(poses)):
        own = np.flatnonzero(pose == number)
        dof = len(own) - 1 - poses.unknowns
        order = own[np.argsort(chi2[own], kind="stable")]
        if dof < 1 or chi2[order[0]] > chi2_limit(dof, CONTRADICTION_PROBABILITY):
            continue
        if chi2[order[1]] - chi2[order[0]] < SINGLE_OUTLIER_RATIO_THRESHOLD:
            continue
        found.append(number)
        places.append((marker[order[0]], sensor[order[0]]))
        sizes.append(off[order[0]])
    return (
        np.array(found, dtype=np.intp),
        np.array(places, dtype=np.intp).reshape(-1, 2),
        np.array(sizes),
    )
