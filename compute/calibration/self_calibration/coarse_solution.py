"""Coarse self-calibration: from cameras wrong by up to 20 % to near the solution."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.normal_equations import HUBER_LIMIT
from compute.calibration.bundle_adjustment.pose_set import PoseSet
from compute.calibration.bundle_adjustment.sensor_prior import SensorPrior
from compute.calibration.bundle_adjustment.solver import approximate_solution
from compute.calibration.self_calibration.datum import align_to_start
from compute.calibration.self_calibration.initial_poses import InitialPoses, start_poses
from compute.calibration.self_calibration.pose_screening import check_poses_left, screen_poses
from compute.calibration.self_calibration.targets import Recording
from compute.camera.model import SensorModel
from compute.errors import NoConvergence, TooFewPoints

Array = NDArray[np.float64]

COARSE_PX: Final = (30.0, 10.0, 3.0, 1.0)
"""Standard deviations of the readings in successive stages while the prior holds the sensors."""
COARSE_RELATIVE_SIGMA: Final = 0.2
"""Standard deviation of the start relative to each parameter's size: the principal distance, half
the pixels for the principal point, half a radian, the distance to the lens."""
LENS_OFFSET_SIGMA_V: Final = 0.1
"""Standard deviation of the lens offset along the slit, relative to the distance: readings
determine it only weakly, through the distortion's terms in v."""
MAX_ROUNDS: Final = 6
OUTLIER_POSE_SHARE: Final = 0.1
"""Share of readings beyond the robust limit from which poses are taken for wrong."""


def _coarse_prior(models: Sequence[SensorModel], pose_sets: Sequence[PoseSet]) -> SensorPrior:
    """Return a prior at the start with standard deviations of COARSE_RELATIVE_SIGMA."""
    information = []
    for model, depth in zip(models, _depths(models, pose_sets), strict=True):
        sizes = np.ones(model.parameter_count)
        sizes[:7] = model.principal_distance_px, 0.5 * model.pixels, 0.5, 0.5, 0.5, depth, depth
        sizes[7:8] = depth
        information.append((1.0 / (COARSE_RELATIVE_SIGMA * sizes)) ** 2)
    return SensorPrior(tuple(models), np.diag(np.concatenate(information)))


def lens_offset_prior(
    models: Sequence[SensorModel], pose_sets: Sequence[PoseSet]
) -> SensorPrior | None:
    """Return the weak prior of the lens offsets along the slits.

    Args:
        models: the starting cameras.
        pose_sets: starting poses, which give the distances to the lenses.

    Returns:
        The prior; None where no sensor has distortion.
    """
    sigma = [LENS_OFFSET_SIGMA_V * depth for depth in _depths(models, pose_sets)]
    return SensorPrior.of_lens_offsets(models, sigma)


def _depths(models: Sequence[SensorModel], pose_sets: Sequence[PoseSet]) -> list[float]:
    centroid = np.concatenate([poses.translation_mm for poses in pose_sets]).mean(axis=0)
    return [abs(float(model.rotation[2] @ centroid) + model.offset_z_mm) for model in models]


def coarse_solution(
    models: Sequence[SensorModel], recordings: Sequence[Recording], sigma: Sequence[Array]
) -> tuple[SensorModel, ...]:
    """Return sensors near the solution.

    First with inflated standard deviations, so that the prior holds what the readings leave open,
    and with new starting poses after every stage; then from the readings alone, with a robust loss,
    until few readings lie beyond its limit.

    Args:
        models: the starting cameras.
        recordings: the readings.
        sigma: their standard deviations, shape (B, K, S) for each recording [px].

    Raises:
        TooFewPoints: no pose can be placed.
        NoConvergence: the start is too wrong.
    """
    current = tuple(models)
    starts = _place_targets(current, recordings, sigma, trusted=False)
    prior = _coarse_prior(models, [start.poses for start in starts])
    for number, coarse in enumerate(COARSE_PX):
        if number:
            starts = _place_targets(current, recordings, sigma)
        pose_sets = [start.poses for start in starts]
        inflated = [replace(p, sigma_px=np.maximum(p.sigma_px, coarse)) for p in pose_sets]
        current = approximate_solution(current, inflated, prior=prior, loss="robust").models
    current = align_to_start(current, models)
    for _ in range(MAX_ROUNDS):
        pose_sets = [start.poses for start in _place_targets(current, recordings, sigma)]
        state = approximate_solution(
            current,
            pose_sets,
            prior=lens_offset_prior(models, pose_sets),
            free_datum=True,
            loss="robust",
        )
        current = align_to_start(state.models, models)
        sizes = np.concatenate([np.abs(one).ravel() for one in state.residuals()])
        beyond = int((sizes > HUBER_LIMIT).sum())
        if beyond < OUTLIER_POSE_SHARE * sum(int(poses.observed_mask.sum()) for poses in pose_sets):
            break
    return current


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
    # An outlier spoils its whole pose; the search can do without it.
    consistent = [screen_poses(models, start).consistent for start in starts]
    check_poses_left(consistent)
    return consistent
