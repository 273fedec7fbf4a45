"""Poses before cameras that are held: every pose by itself, all at once."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.normal_equations import (
    AdjustmentState,
    build_normal_equations,
)
from compute.calibration.bundle_adjustment.pose_set import PoseSet
from compute.camera.model import SensorModel

Array = NDArray[np.float64]

MAX_ITERATIONS: Final = 60
CONVERGENCE_TOLERANCE: Final = 1e-9
"""Decrease of a pose's chi2 that its last step promised, beside its own rounding."""


def resect(models: Sequence[SensorModel], poses: PoseSet) -> tuple[PoseSet, Array]:
    """Fit each pose to its readings by least squares, with a damping of its own.

    Args:
        models: the cameras, which are taken as they are.
        poses: where to start, all markers that were read in front of the lenses.

    Returns:
        The poses, and the sum of squared residuals over sigma of each, shape (B,).
    """
    chi2 = _chi2(models, poses)
    damping = np.full(len(poses), 1e-4)
    ones = np.ones(poses.readings_px.shape)
    places = np.arange(poses.unknowns)
    open_ = np.isfinite(chi2)
    for _ in range(MAX_ITERATIONS):
        if not open_.any():
            break
        block = build_normal_equations(
            AdjustmentState(tuple(models), (poses,)), [ones], None
        ).blocks[0]
        normal, gradient = block.normal.copy(), block.gradient
        diagonal = normal[:, places, places]
        floor = 1e-300 + 1e-15 * diagonal.max(axis=1, keepdims=True)
        normal[:, places, places] += damping[:, None] * diagonal + floor
        normal[~open_] = np.eye(poses.unknowns)
        step: Array = -np.asarray(np.linalg.solve(normal, gradient[..., None]))[..., 0]
        step[~open_] = 0.0
        trial = poses.retract(step)
        new = _chi2(models, trial)
        better = open_ & (new <= chi2)
        promised = -(gradient * step).sum(axis=1)
        poses = replace(
            poses,
            translation_mm=np.where(better[:, None], trial.translation_mm, poses.translation_mm),
            rotation=np.where(better[:, None, None], trial.rotation, poses.rotation),
        )
        chi2 = np.where(better, new, chi2)
        open_ = open_ & (promised > CONVERGENCE_TOLERANCE + 1e-12 * chi2) & (damping < 1e12)
        damping *= np.where(better, 0.1, 10.0)
    return poses, chi2


def _chi2(models: Sequence[SensorModel], poses: PoseSet) -> Array:
    squares = AdjustmentState(tuple(models), (poses,)).residuals()[0] ** 2
    total: Array = squares.sum(axis=(1, 2))
    placed = poses.prior()
    if placed is not None:
        away, information = placed
        total = total + np.einsum("bi,bij,bj->b", away, information, away)
    return total
