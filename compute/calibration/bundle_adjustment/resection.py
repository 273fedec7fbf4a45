"""Resection: poses of targets before fixed cameras, each pose fitted by itself."""

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
"""Decrease of a pose's chi2 that its last step predicted, beside its own rounding."""


def resect(models: Sequence[SensorModel], poses: PoseSet) -> tuple[PoseSet, Array]:
    """Fit each pose to its readings by Levenberg-Marquardt, with its own damping.

    Args:
        models: the cameras, held fixed.
        poses: B starting poses, with all observed markers in front of the lenses.

    Returns:
        The poses, and the sum of squared residuals over sigma of each, shape (B,).
    """
    chi2 = _chi2(models, poses)
    damping = np.full(len(poses), 1e-4)
    ones = np.ones(poses.readings_px.shape)
    diagonal_index = np.arange(poses.unknowns)
    active = np.isfinite(chi2)
    for _ in range(MAX_ITERATIONS):
        if not active.any():
            break
        block = build_normal_equations(
            AdjustmentState(tuple(models), (poses,)), [ones], None
        ).blocks[0]
        normal, gradient = block.normal.copy(), block.gradient
        diagonal = normal[:, diagonal_index, diagonal_index]
        floor = 1e-300 + 1e-15 * diagonal.max(axis=1, keepdims=True)
        normal[:, diagonal_index, diagonal_index] += damping[:, None] * diagonal + floor
        normal[~active] = np.eye(poses.unknowns)
        step: Array = -np.asarray(np.linalg.solve(normal, gradient[..., None]))[..., 0]
        step[~active] = 0.0
        trial = poses.retract(step)
        new = _chi2(models, trial)
        better = active & (new <= chi2)
        predicted = -(gradient * step).sum(axis=1)
        poses = replace(
            poses,
            translation_mm=np.where(better[:, None], trial.translation_mm, poses.translation_mm),
            rotation=np.where(better[:, None, None], trial.rotation, poses.rotation),
        )
        chi2 = np.where(better, new, chi2)
        active = active & (predicted > CONVERGENCE_TOLERANCE + 1e-12 * chi2) & (damping < 1e12)
        damping *= np.where(better, 0.1, 10.0)
    return poses, chi2


def _chi2(models: Sequence[SensorModel], poses: PoseSet) -> Array:
    squares = AdjustmentState(tuple(models), (poses,)).residuals()[0] ** 2
    total: Array = squares.sum(axis=(1, 2))
    prior = poses.prior()
    if prior is not None:
        difference, information = prior
        total = total + np.einsum("bi,bij,bj->b", difference, information, difference)
    return total
