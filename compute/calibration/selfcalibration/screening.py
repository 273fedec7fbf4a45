"""Poses that contradict their own readings, and the single reading that is to blame."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.adjustment.covariance import undetermined_poses
from compute.calibration.adjustment.equations import State
from compute.calibration.adjustment.poses import PoseSet
from compute.calibration.adjustment.resection import resected
from compute.calibration.selfcalibration.starts import Start, selected
from compute.camera.model import SensorModel
from compute.reconstruction.points import chi2_limit

Array = NDArray[np.float64]

CONTRADICTION: Final = 1e-6
"""Chance that a good pose is taken for one that holds a wrong reading."""
MUCH_WORSE: Final = 10.0
"""Squared misfit over the median of all, in their degrees of freedom, that is no fault of the
cameras, as long as these are not known well."""
CLEARLY: Final = 20.0
"""By how much chi2 must be lower without one reading than without any other for it to blame."""


@dataclass(frozen=True, eq=False)
class Screened:
    """Poses fitted one by one to cameras that are held.

    Args:
        start: all of them.
        misfit: chi2 over degrees of freedom, shape (B,); 0 without any.
        good: those that agree with their readings, as far as the cameras allow.
    """

    start: Start
    misfit: Array
    good: NDArray[np.bool_]


def screened(models: Sequence[SensorModel], start: Start) -> Screened:
    """Fit the poses one by one and tell those that contradict their readings."""
    poses, chi2 = resected(models, start.poses)
    freedom = poses.seen.sum(axis=(1, 2)) - poses.unknowns
    misfit = np.where(freedom > 0, chi2 / np.maximum(freedom, 1), 0.0)
    checked = misfit[freedom > 0]
    usual = float(np.median(checked)) if len(checked) else 0.0
    limits = _limits(freedom) / np.maximum(freedom, 1)
    good = (misfit <= np.maximum(limits, MUCH_WORSE * usual)) & np.isfinite(chi2)
    return Screened(Start(poses, start.kept), misfit, good)


def _limits(freedom: NDArray[np.int_]) -> Array:
    return np.array([chi2_limit(int(one), CONTRADICTION) for one in freedom])


def culprits(
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
    trials = selected(poses, pose)
    readings = trials.readings_px.copy()
    readings[np.arange(len(pose)), marker, sensor] = np.nan
    trials = replace(trials, readings_px=readings)
    fit = ~undetermined_poses(models, trials)
    chi2 = np.full(len(pose), np.inf)
    off = np.zeros(len(pose))
    if fit.any():
        fitted, chi2[fit] = resected(models, selected(trials, fit))
        where = (np.arange(len(fitted)), marker[fit], sensor[fit])
        whole = replace(fitted, readings_px=selected(poses, pose[fit]).readings_px)
        off[fit] = State(tuple(models), (whole,)).residuals()[0][where]
    found, places, sizes = [], [], []
    for number in range(len(poses)):
        own = np.flatnonzero(pose == number)
        freedom = len(own) - 1 - poses.unknowns
        order = own[np.argsort(chi2[own], kind="stable")]
        if freedom < 1 or chi2[order[0]] > chi2_limit(freedom, CONTRADICTION):
            continue
        if chi2[order[1]] - chi2[order[0]] < CLEARLY:
            continue
        found.append(number)
        places.append((marker[order[0]], sensor[order[0]]))
        sizes.append(off[order[0]])
    return (
        np.array(found, dtype=np.intp),
        np.array(places, dtype=np.intp).reshape(-1, 2),
        np.array(sizes),
    )
