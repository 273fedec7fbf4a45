"""HeldOutLengths: known lengths measured at poses that the cameras never saw (cross-validation)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.adjustment_result import undetermined_poses
from compute.calibration.bundle_adjustment.solver import adjust
from compute.calibration.self_calibration.coarse_solution import lens_offset_prior
from compute.calibration.self_calibration.initial_poses import (
    InitialPoses,
    marker_distances,
    start_poses,
    triangulate,
)
from compute.calibration.self_calibration.pose_screening import screen_poses
from compute.calibration.self_calibration.result import SelfCalibration
from compute.calibration.self_calibration.targets import Recording
from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.errors import LumilineError
from compute.progress import Progress, no_progress

Array = NDArray[np.float64]

FOLDS: Final = 5
RUN_POSES: Final = 5
"""Poses in a row that are held out together: neighbours on the way of a wand are much alike."""


@dataclass(frozen=True)
class HeldOutLengths:
    """Errors of the target's lengths at poses that the cameras were not made from.

    Args:
        poses: poses that were held out, each once.
        lengths: lengths measured at them.
        rms_mm: root mean square of measured minus known lengths [mm].
        mean_mm: their mean [mm]: an error of scale.
        max_mm: the largest, without its sign [mm].
    """

    poses: int
    lengths: int
    rms_mm: float
    mean_mm: float
    max_mm: float


def held_out_lengths(
    found: SelfCalibration, recordings: Sequence[Recording], progress: Progress = no_progress
) -> HeldOutLengths | None:
    """Measure the target's lengths at poses that the cameras never saw.

    The poses are divided into FOLDS parts, in runs of RUN_POSES; for each part the cameras are
    adjusted to the others and measure the lengths at this one. Readings and poses that the
    calibration rejected stay out, exchanged readings are exchanged back. The lengths of the target
    as it was adjusted with all poses are the known ones, which matters only for a body of unknown
    shape.

    Args:
        found: the calibration from all poses.
        recordings: what it was made from.
        progress: called with the fraction done and the stage.

    Returns:
        The errors; None where the poses without a part are too few to adjust cameras to.
    """
    models = tuple(fit.model for fit in found.calibration.sensors)
    starts = []
    for recording, sigma in _consistent_readings(found, recordings):
        start = start_poses(models, recording, sigma)
        start = start.select(~undetermined_poses(models, start.poses))
        starts.append(screen_poses(models, start).consistent)
    errors, poses = [], 0
    for fold in range(FOLDS):
        progress(fold / FOLDS, "lengths at poses held out")
        held = [start.pose_index // RUN_POSES % FOLDS == fold for start in starts]
        try:
            cameras = _adjusted_to(models, starts, [~one for one in held])
        except LumilineError:
            return None
        for start, one, target in zip(starts, held, found.targets, strict=True):
            markers = triangulate(cameras, start.select(one).poses.readings_px)
            measured = marker_distances(markers)
            error = measured - marker_distances(np.array(target.markers_mm))
            poses += int(np.isfinite(error).any(axis=1).sum())
            errors.append(error[np.isfinite(error)])
    progress(1.0, "done")
    every = np.concatenate(errors)
    if len(every) == 0:
        return None
    return HeldOutLengths(
        poses,
        len(every),
        float(np.sqrt(np.mean(every**2))),
        float(every.mean()),
        float(np.abs(every).max()),
    )


def _consistent_readings(
    found: SelfCalibration, recordings: Sequence[Recording]
) -> list[tuple[Recording, Array]]:
    """Return the recordings without rejected readings, and the sigmas used (B, K, S)."""
    names = [fit.model.name for fit in found.calibration.sensors]
    fitted = np.array([fit.sigma_px for fit in found.calibration.sensors])
    cleaned = []
    for number, recording in enumerate(recordings, start=1):
        readings = recording.readings_px.copy()
        if recording.sigma_px is None:
            sigma = np.broadcast_to(fitted, readings.shape).copy()
        else:
            sigma = recording.sigma_px.copy()
        for swap in found.exchanged:
            if swap.recording == number:
                pair = [swap.first - 1, swap.second - 1]
                column = names.index(swap.sensor)
                for values in (readings, sigma):
                    values[swap.pose - 1, pair, column] = values[swap.pose - 1, pair[::-1], column]
        for one in found.rejected:
            if one.recording == number:
                readings[one.pose - 1, one.marker - 1, names.index(one.sensor)] = np.nan
        cleaned.append((replace(recording, readings_px=readings, sigma_px=None), sigma))
    return cleaned


def _adjusted_to(
    models: Sequence[SensorModel],
    starts: Sequence[InitialPoses],
    kept: Sequence[NDArray[np.bool_]],
) -> CameraStack:
    """Return the cameras adjusted to the kept poses, in any world frame."""
    pose_sets = [start.select(one).poses for start, one in zip(starts, kept, strict=True)]
    adjusted = adjust(
        models,
        pose_sets,
        prior=lens_offset_prior(models, pose_sets),
        free_datum=True,
    )
    return CameraStack.of(adjusted.models)
