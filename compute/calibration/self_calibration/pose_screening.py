"""Screening of poses: those that contradict their readings, and single outliers in them."""

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
"""Probability that a good pose is taken for one with an outlier."""
WORSE_RATIO_THRESHOLD: Final = 10.0
"""Reduced chi2 of a pose over the median of all from which its own readings are at fault, and not
the cameras, which may still be inaccurate."""
SINGLE_OUTLIER_RATIO_THRESHOLD: Final = 20.0
"""Difference of chi2 to that without any other reading that identifies the outlier."""


@dataclass(frozen=True, eq=False)
class ScreenedPoses:
    """Poses fitted one by one to fixed cameras.

    Args:
        start: all poses, fitted.
        misfit: chi2 over degrees of freedom, shape (B,); 0 without any.
        good: poses consistent with their readings, within the cameras' errors, shape (B,).
    """

    start: InitialPoses
    misfit: Array
    good: NDArray[np.bool_]


def screen_poses(models: Sequence[SensorModel], start: InitialPoses) -> ScreenedPoses:
    """Fit each pose by itself and test whether it contradicts its readings.

    Args:
        models: the S cameras, held fixed.
        start: the poses.
    """
    poses, chi2 = resect(models, start.poses)
    dof = poses.seen.sum(axis=(1, 2)) - poses.unknowns
    misfit = np.where(dof > 0, chi2 / np.maximum(dof, 1), 0.0)
    checked = misfit[dof > 0]
    typical = float(np.median(checked)) if len(checked) else 0.0
    limits = _limits(dof) / np.maximum(dof, 1)
    good = (misfit <= np.maximum(limits, WORSE_RATIO_THRESHOLD * typical)) & np.isfinite(chi2)
    return ScreenedPoses(InitialPoses(poses, start.pose_index), misfit, good)


def _limits(dof: NDArray[np.int_]) -> Array:
    return np.array([chi2_limit(int(one), CONTRADICTION_PROBABILITY) for one in dof])


def find_outlier_readings(
    models: Sequence[SensorModel], poses: PoseSet
) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Find the single outlier of each contradictory pose, if one reading explains it.

    Every reading is left out in turn. It is an outlier if the rest agree, and do so clearly better
    than without any other reading; a pose with two outliers has no such reading.

    Args:
        models: the S cameras, held fixed.
        poses: contradictory poses.

    Returns:
        Indices of the poses that have one, shape (N,); its marker and sensor, shape (N, 2); and its
        residual over sigma from the fit without it, shape (N,).
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
    found, marker_and_sensor, sizes = [], [], []
    for number in range(len(poses)):
        trial_index = np.flatnonzero(pose == number)
        dof = len(trial_index) - 1 - poses.unknowns
        order = trial_index[np.argsort(chi2[trial_index], kind="stable")]
        if dof < 1 or chi2[order[0]] > chi2_limit(dof, CONTRADICTION_PROBABILITY):
            continue
        if chi2[order[1]] - chi2[order[0]] < SINGLE_OUTLIER_RATIO_THRESHOLD:
            continue
        found.append(number)
        marker_and_sensor.append((marker[order[0]], sensor[order[0]]))
        sizes.append(off[order[0]])
    return (
        np.array(found, dtype=np.intp),
        np.array(marker_and_sensor, dtype=np.intp).reshape(-1, 2),
        np.array(sizes),
    )
