"""From cameras that may be wrong by a fifth to the solution's neighbourhood."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.pose_set import PoseSet
from compute.calibration.bundle_adjustment.robust_loss import HUBER_LIMIT
from compute.calibration.bundle_adjustment.sensor_prior import SensorPrior
from compute.calibration.bundle_adjustment.solver import approximate_solution
from compute.calibration.self_calibration.datum import align_to_start
from compute.calibration.self_calibration.initial_poses import (
    InitialPoses,
    select_poses,
    start_poses,
)
from compute.calibration.self_calibration.pose_screening import screen_poses
from compute.calibration.self_calibration.targets import Recording
from compute.camera.model import PARAMETER_COUNT, SensorModel
from compute.errors import NoConvergence, TooFewPoints

Array = NDArray[np.float64]

COARSE_PX: Final = (30.0, 10.0, 3.0, 1.0)
"""Deviations with which readings count one after the other while the start holds the sensors."""
COARSE_RELATIVE_SIGMA: Final = 0.2
"""What the start is taken to be wrong by, of each parameter's size: the principal distance, half
the pixels for the principal point, half a radian, the distance to the lens."""
LENS_OFFSET_SIGMA_V: Final = 0.1
"""Deviation of the shift along the slit, of the distance: v, and with it the distortion's terms,
knows it only weakly."""
MAX_ROUNDS: Final = 6
OUTLIER_POSE_SHARE: Final = 0.1
"""Share of readings beyond the robust limit at which poses hang in wrong places."""


def coarse_prior(models: Sequence[SensorModel], pose_sets: Sequence[PoseSet]) -> SensorPrior:
    """Return the start as a prior that is wrong by COARSE_RELATIVE_SIGMA."""
    information = [
        (1.0 / (COARSE_RELATIVE_SIGMA * size)) ** 2
        for model, depth in zip(models, _depths(models, pose_sets), strict=True)
        for size in (
            model.principal_distance_px,
            0.5 * model.pixels,
            *(0.5, 0.5, 0.5),
            depth,
            depth,
            *((depth,) + (1.0,) * (model.parameter_count - PARAMETER_COUNT - 1))[
                : model.parameter_count - PARAMETER_COUNT
            ],
        )
    ]
    return SensorPrior(tuple(models), np.diag(information))


def lens_offset_prior(
    models: Sequence[SensorModel], pose_sets: Sequence[PoseSet]
) -> SensorPrior | None:
    """Return the weak prior of shifts along the slits; None where no sensor has distortion."""
    if all(model.distortion is None for model in models):
        return None
    information = []
    for model, depth in zip(models, _depths(models, pose_sets), strict=True):
        own = np.zeros(model.parameter_count)
        if model.distortion is not None:
            own[PARAMETER_COUNT] = (LENS_OFFSET_SIGMA_V * depth) ** -2
        information.append(own)
    return SensorPrior(tuple(models), np.diag(np.concatenate(information)))


def _depths(models: Sequence[SensorModel], pose_sets: Sequence[PoseSet]) -> list[float]:
    middle = np.concatenate([poses.translation_mm for poses in pose_sets]).mean(axis=0)
    return [abs(float(model.rotation[2] @ middle) + model.offset_z_mm) for model in models]


def coarse_solution(
    models: Sequence[SensorModel], recordings: Sequence[Recording], sigma: Sequence[Array]
) -> tuple[SensorModel, ...]:
    """Return sensors near the solution.

    First with coarse readings, so that the start holds what they leave open, and poses that are
    placed anew after every stage; then by the readings alone, robustly, until no pose hangs in a
    wrong place.

    Args:
        models: the start.
        recordings: the readings.
        sigma: their standard deviations, (B, K, S) for each.

    Raises:
        TooFewPoints: no pose can be placed.
        NoConvergence: the start is too wrong.
    """
    now = tuple(models)
    starts = _place_targets(now, recordings, sigma, trusted=False)
    prior = coarse_prior(models, [start.poses for start in starts])
    for number, coarse in enumerate(COARSE_PX):
        if number:
            starts = _place_targets(now, recordings, sigma)
        blurred = [_inflate_sigma(start.poses, coarse) for start in starts]
        now = approximate_solution(now, blurred, prior=prior, loss="robust").models
    now = align_to_start(now, models)
    for _ in range(MAX_ROUNDS):
        pose_sets = [start.poses for start in _place_targets(now, recordings, sigma)]
        state = approximate_solution(
            now,
            pose_sets,
            prior=lens_offset_prior(models, pose_sets),
            free_datum=True,
            loss="robust",
        )
        now = align_to_start(state.models, models)
        sizes = np.concatenate([np.abs(one).ravel() for one in state.residuals()])
        beyond = int((sizes > HUBER_LIMIT).sum())
        if beyond < OUTLIER_POSE_SHARE * sum(int(poses.seen.sum()) for poses in pose_sets):
            break
    return now


def _place_targets(
    models: Sequence[SensorModel],
    recordings: Sequence[Recording],
    sigma: Sequence[Array],
    trusted: bool = True,
) -> list[InitialPoses]:
    try:
        starts = [
            start_poses(models, recording, one, trusted=trusted)
            for recording, one in zip(recordings, sigma, strict=True)
        ]
    except TooFewPoints as error:
        if not trusted:
            raise
        raise NoConvergence(
            f"the search left the start for cameras where {error.detail}; start nearer"
        ) from None
    if not trusted:
        return starts
    # A wrong reading bends its whole pose; the search can do without.
    fitted = [screen_poses(models, start) for start in starts]
    return [
        InitialPoses(select_poses(one.start.poses, one.good), one.start.pose_index[one.good])
        for one in fitted
    ]


def _inflate_sigma(poses: PoseSet, deviation_px: float) -> PoseSet:
    return replace(poses, sigma_px=np.maximum(poses.sigma_px, deviation_px))
