"""Poses fitted one by one (resection); those that contradict their readings, and outliers."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.adjustment_result import undetermined_poses
from compute.calibration.bundle_adjustment.normal_equations import AdjustmentState
from compute.calibration.bundle_adjustment.pose_set import PoseSet
from compute.calibration.self_calibration.initial_poses import InitialPoses, fit_poses, triangulate
from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.errors import NoConvergence
from compute.reconstruction.triangulation import chi2_limit

Array = NDArray[np.float64]

MAX_ITERATIONS: Final = 60
CONVERGENCE_TOLERANCE: Final = 1e-9
"""Decrease of a pose's chi2 that its last step predicted."""
RELATIVE_TOLERANCE: Final = 1e-7
"""The same over chi2: where readings contradict one another the last digits tell nothing."""
CONTRADICTION_PROBABILITY: Final = 1e-6
"""Probability that a good pose is taken for one with an outlier."""
WORSE_RATIO_THRESHOLD: Final = 10.0
"""Reduced chi2 of a pose over the median of all from which its own readings are at fault, and not
the cameras, which may still be inaccurate."""
SINGLE_OUTLIER_RATIO_THRESHOLD: Final = 20.0
"""Difference of chi2 to that without any other reading that identifies the outlier."""
CURVATURE_LIMIT: Final = 1.0
"""Largest curvature of a pose, see ``pose_curvature``, at which least squares holds for it."""


@dataclass(frozen=True, eq=False)
class ScreenedPoses:
    """Poses fitted one by one to fixed cameras.

    Args:
        start: all poses, fitted.
        good: poses consistent with their readings, within the cameras' errors, shape (B,).
    """

    start: InitialPoses
    good: NDArray[np.bool_]

    @property
    def consistent(self) -> InitialPoses:
        """The good poses."""
        return self.start.select(self.good)


def screen_poses(models: Sequence[SensorModel], start: InitialPoses) -> ScreenedPoses:
    """Fit each pose by itself and test whether it contradicts its readings.

    Args:
        models: the S cameras, held fixed.
        start: the poses.
    """
    poses, chi2 = resect(models, start.poses)
    dof = poses.observed_mask.sum(axis=(1, 2)) - poses.unknowns
    misfit = np.where(dof > 0, chi2 / np.maximum(dof, 1), 0.0)
    checked = misfit[dof > 0]
    typical = float(np.median(checked)) if len(checked) else 0.0
    limits = [chi2_limit(int(one), CONTRADICTION_PROBABILITY) for one in dof] / np.maximum(dof, 1)
    good = (misfit <= np.maximum(limits, WORSE_RATIO_THRESHOLD * typical)) & np.isfinite(chi2)
    return ScreenedPoses(InitialPoses(poses, start.pose_index), good)


def check_poses_left(starts: Sequence[InitialPoses]) -> None:
    """Check that each recording has poses left after screening.

    Args:
        starts: the poses that are left, of each recording.

    Raises:
        NoConvergence: a recording has none.
    """
    for number, start in enumerate(starts):
        if len(start.poses) == 0:
            recording = "the recording" if len(starts) == 1 else f"recording {number + 1}"
            raise NoConvergence(
                f"no pose of {recording} agrees with the cameras that the search ended at, or each "
                "may as well be another: the readings hardly tell the cameras, or the lengths do "
                "not belong to what was moved"
            )


def pose_curvature(models: Sequence[SensorModel], poses: PoseSet) -> Array:
    """Return how far fitted poses are from linear within their standard deviation, shape (B,).

    In a pose's least certain direction, one standard deviation away, the readings lie that many
    standard deviations from the linear prediction (curvature: Bates and Watts,
    doi:10.1111/j.2517-6161.1980.tb01094.x). Beyond 1 the readings may as well be those of another
    pose, as where two solutions of a wand are about to meet: neither its covariance nor a step of
    Gauss and Newton means anything.

    Args:
        models: the S cameras, held fixed.
        poses: fitted to them.

    Returns:
        The curvatures; inf where a marker comes to lie behind a lens.
    """

    def residuals(poses: PoseSet) -> Array:
        return AdjustmentState(tuple(models), (poses,)).residuals()[0]

    normal, _ = _pose_equations(CameraStack.of(models), poses)
    scale = np.sqrt(np.maximum(np.einsum("bii->bi", normal), np.finfo(np.float64).tiny))
    values, vectors = np.linalg.eigh(normal / (scale[:, :, None] * scale[:, None]))
    smallest = np.maximum(values[:, :1], np.finfo(np.float64).eps)
    step = vectors[:, :, 0] / np.sqrt(smallest) / scale
    ahead, behind = residuals(poses.retract(step)), residuals(poses.retract(-step))
    second = 0.5 * (ahead + behind) - residuals(poses)
    curvature = np.sqrt((second**2).sum(axis=(1, 2)))
    return np.where(np.isfinite(curvature), curvature, np.inf)


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
    seen = poses.observed_mask
    pose, marker, sensor = np.nonzero(seen)
    trials = poses.select(pose)
    readings = trials.readings_px.copy()
    readings[np.arange(len(pose)), marker, sensor] = np.nan
    trials = replace(trials, readings_px=readings)
    fit = ~undetermined_poses(models, trials)
    chi2 = np.full(len(pose), np.inf)
    off = np.zeros(len(pose))
    if fit.any():
        fitted, chi2[fit] = resect(models, trials.select(fit))
        where = (np.arange(len(fitted)), marker[fit], sensor[fit])
        whole = replace(fitted, readings_px=poses.select(pose[fit]).readings_px)
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


def find_exchanges(
    models: Sequence[SensorModel], poses: PoseSet
) -> list[tuple[int, int, int, int]]:
    """Find contradictory poses that agree once one sensor's readings of two markers are exchanged.

    The exchange must make all readings agree, and clearly better than any other exchange.

    Args:
        models: the S cameras, held fixed.
        poses: contradictory poses.

    Returns:
        Pose, two markers and sensor of each exchange, as indices.
    """
    seen = poses.observed_mask
    trials = [
        (pose, first, second, sensor)
        for pose in range(len(poses))
        for first, second in zip(*np.triu_indices(len(poses.shape), 1), strict=True)
        for sensor in np.flatnonzero(seen[pose, first] & seen[pose, second])
    ]
    if not trials:
        return []
    index = np.array(trials)
    pose, first, second, sensor = index.T
    tried = poses.select(pose)
    row = np.arange(len(pose))
    readings, sigma = tried.readings_px.copy(), tried.sigma_px.copy()
    for values in (readings, sigma):
        kept = values[row, first, sensor].copy()
        values[row, first, sensor] = values[row, second, sensor]
        values[row, second, sensor] = kept
    # The pose of exchanged readings may be stuck: begin anew from the markers.
    marker = triangulate(CameraStack.of(models), readings)
    placed = np.isfinite(marker[..., 0]).sum(axis=1) >= (3 if poses.unknowns == 6 else 2)
    rotation, translation = tried.rotation.copy(), tried.translation_mm.copy()
    rotation[placed], translation[placed] = fit_poses(poses.shape, marker[placed])
    _, chi2 = resect(
        models,
        replace(
            tried,
            rotation=rotation,
            translation_mm=translation,
            readings_px=readings,
            sigma_px=sigma,
        ),
    )
    chi2 = np.where(np.isfinite(chi2), chi2, np.inf)
    found = []
    for number in range(len(poses)):
        own = np.flatnonzero(pose == number)
        dof = int(seen[number].sum()) - poses.unknowns
        order = own[np.argsort(chi2[own], kind="stable")]
        if len(own) == 0 or dof < 1:
            continue
        if not chi2[order[0]] <= chi2_limit(dof, CONTRADICTION_PROBABILITY):
            continue
        if len(order) > 1 and chi2[order[1]] - chi2[order[0]] < SINGLE_OUTLIER_RATIO_THRESHOLD:
            continue
        a, b, c, d = index[order[0]].tolist()
        found.append((a, b, c, d))
    return found


def resect(models: Sequence[SensorModel], poses: PoseSet) -> tuple[PoseSet, Array]:
    """Fit each pose to its readings by Levenberg-Marquardt, with its own damping.

    Args:
        models: the cameras, held fixed.
        poses: B starting poses without known positions, with all observed markers in front of the
            lenses.

    Returns:
        The poses, and the sum of squared residuals over sigma of each, shape (B,).
    """
    cameras = CameraStack.of(models)
    chi2 = _chi2(cameras, poses)
    translation, rotation = poses.translation_mm.copy(), np.array(poses.rotation)
    damping = np.full(len(poses), 1e-4)
    diagonal_index = np.arange(poses.unknowns)
    active = np.flatnonzero(np.isfinite(chi2))
    part = poses.select(active)
    for _ in range(MAX_ITERATIONS):
        if len(active) == 0:
            break
        normal, gradient = _pose_equations(cameras, part)
        diagonal = normal[:, diagonal_index, diagonal_index]
        floor = 1e-300 + 1e-15 * diagonal.max(axis=1, keepdims=True)
        normal[:, diagonal_index, diagonal_index] += damping[active, None] * diagonal + floor
        step: Array = -np.asarray(np.linalg.solve(normal, gradient[..., None]))[..., 0]
        trial = part.retract(step)
        new = _chi2(cameras, trial)
        better = new <= chi2[active]
        translation[active[better]] = trial.translation_mm[better]
        rotation[active[better]] = trial.rotation[better]
        chi2[active[better]] = new[better]
        predicted = -(gradient * step).sum(axis=1)
        going = predicted > CONVERGENCE_TOLERANCE + RELATIVE_TOLERANCE * chi2[active]
        going &= damping[active] < 1e12
        damping[active] *= np.where(better, 0.1, 10.0)
        active = active[going]
        part = replace(poses, translation_mm=translation, rotation=rotation).select(active)
    return replace(poses, translation_mm=translation, rotation=rotation), chi2


def _pose_equations(cameras: CameraStack, poses: PoseSet) -> tuple[Array, Array]:
    """Return the normal matrices (B, d, d) and gradients (B, d) of poses, cameras held fixed."""
    seen = poses.observed_mask
    projected, by_marker = cameras.linearise(poses.marker_positions().reshape(-1, 3))
    weight = np.where(seen, 1.0 / poses.sigma_px, 0.0)
    difference = projected.reshape(seen.shape) - poses.readings_px
    residual = np.where(seen, difference * weight, 0.0).reshape(len(poses), -1, 1)
    by_marker = np.nan_to_num(by_marker).reshape(*seen.shape, 3) * weight[..., None]
    jacobian = (by_marker @ poses.marker_jacobian()).reshape(len(poses), -1, poses.unknowns)
    transposed = jacobian.transpose(0, 2, 1)
    return transposed @ jacobian, (transposed @ residual)[..., 0]


def _chi2(cameras: CameraStack, poses: PoseSet) -> Array:
    projected = cameras.project(poses.marker_positions().reshape(-1, 3))
    difference = projected.reshape(poses.readings_px.shape) - poses.readings_px
    squares = np.where(poses.observed_mask, difference / poses.sigma_px, 0.0) ** 2
    return np.asarray(squares.sum(axis=(1, 2)))
