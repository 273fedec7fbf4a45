"""Covariance of an adjustment's global parameters, and tests that they are determined."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.gauge import (
    centring,
    inner_constraints,
    orthogonal_complement,
    rigid_motion_jacobian,
)
from compute.calibration.bundle_adjustment.normal_equations import (
    AdjustmentState,
    NormalEquations,
    ReducedEquations,
    build_normal_equations,
)
from compute.calibration.bundle_adjustment.pose_set import PoseSet
from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.errors import UndeterminedParameters

Array = NDArray[np.float64]

MIN_SINGULAR_RATIO: Final = 1e-11
"""Smallest eigenvalue of the globals' normal matrix with a diagonal of 1, of the largest, that
is distinguishable from rounding: a parameter combination 3e5 times less certain than the best."""
MAX_NAMED_PARAMETERS: Final = 4
"""Parameters that a message names of an open combination."""


def check_poses(state: AdjustmentState, equations: NormalEquations) -> None:
    """Check that the readings determine every pose.

    Args:
        state: sensors and poses.
        equations: their normal equations.

    Raises:
        UndeterminedParameters: the first pose that they do not.
    """
    for number, block in enumerate(equations.blocks):
        undetermined = np.flatnonzero(_is_singular(block.normal))
        if len(undetermined):
            pose = int(undetermined[0])
            seen = int(state.pose_sets[number].seen[pose].sum())
            raise UndeterminedParameters(
                f"pose {pose + 1} (set {number + 1}) is not determined by its {seen} readings; "
                "leave it out",
                pose=pose + 1,
                readings=seen,
            )


def undetermined_poses(models: Sequence[SensorModel], poses: PoseSet) -> NDArray[np.bool_]:
    """Return which poses the readings do not determine.

    Args:
        models: the sensors, held fixed.
        poses: B poses with their readings.

    Returns:
        Mask, shape (B,).
    """
    weights = np.ones(poses.readings_px.shape)
    return _is_singular(
        build_normal_equations(AdjustmentState(tuple(models), (poses,)), [weights], None)
        .blocks[0]
        .normal
    )


def _is_singular(normal: Array) -> NDArray[np.bool_]:
    """Return which matrices (B, d, d) are numerically singular."""
    diagonal = np.sqrt(np.maximum(np.einsum("bii->bi", normal), 1e-300))
    scaled = normal / (diagonal[:, :, None] * diagonal[:, None])
    return np.asarray(~(np.linalg.eigvalsh(scaled)[:, 0] > MIN_SINGULAR_RATIO))


def global_covariance(
    state: AdjustmentState,
    reduced: ReducedEquations,
    adjusted_parameters: NDArray[np.bool_],
    free_datum: bool,
    noise_equations: NormalEquations | None,
) -> Array:
    """Return the covariance of the global parameters, shape (F, F); 0 for held ones.

    Args:
        state: the solution.
        reduced: its undamped reduced equations.
        adjusted_parameters: which globals were adjusted, shape (F,).
        free_datum: see ``adjust``.
        noise_equations: with a robust loss, the equations weighted by the variance of the loss's
            derivative; None: least squares.

    Raises:
        UndeterminedParameters: a combination of parameters is undetermined.
    """
    if not adjusted_parameters.any():
        return np.zeros((len(adjusted_parameters), len(adjusted_parameters)))
    sensors = sum(model.parameter_count for model in state.models)
    centroid = np.concatenate(
        [poses.marker_positions().reshape(-1, 3) for poses in state.pose_sets]
    ).mean(axis=0)
    centre = np.eye(len(adjusted_parameters))
    centre[:sensors, :sensors] = centring(state.models, centroid)
    back = np.linalg.inv(centre)
    # What is held is held in the user's frame: the columns of those that vary.
    change = (
        back
        if adjusted_parameters.all()
        else np.eye(len(adjusted_parameters))[:, adjusted_parameters]
    )
    normal = change.T @ reduced.normal @ change
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(normal), 1e-300))
    scaled = normal * scale[:, None] * scale
    motion = None
    if free_datum:
        motion = np.zeros((len(adjusted_parameters), 6))
        motion[:sensors] = rigid_motion_jacobian(state.models)
        motion = centre @ motion / scale[:, None]
    _check_determined(scaled, motion, _names(state, adjusted_parameters))
    if free_datum:
        basis = orthogonal_complement(
            scale[:, None] * (change.T @ _datum(state, len(adjusted_parameters)))
        )
    else:
        basis = np.eye(len(scaled))
    inverse = basis @ np.linalg.inv(basis.T @ scaled @ basis) @ basis.T
    cofactor = change @ (inverse * scale[:, None] * scale) @ change.T
    if noise_equations is not None:
        cofactor = cofactor @ _propagate(noise_equations, reduced) @ cofactor
    covariance: Array = 0.5 * (cofactor + cofactor.T)
    return covariance


def _propagate(noise_equations: NormalEquations, reduced: ReducedEquations) -> Array:
    """Return the variance of the reduced gradient, shape (F, F)."""
    total = noise_equations.normal.copy()
    for block, propagated in zip(noise_equations.blocks, reduced.back_substitution, strict=True):
        crossed = np.einsum("bfd,bdg->fg", block.mixed, propagated, optimize=True)
        total -= crossed + crossed.T
        total += np.einsum("bdf,bde,beg->fg", propagated, block.normal, propagated, optimize=True)
    return total


def _check_determined(scaled: Array, motion: Array | None, names: Sequence[str]) -> None:
    basis = np.eye(len(scaled)) if motion is None else orthogonal_complement(motion)
    values, vectors = np.linalg.eigh(basis.T @ scaled @ basis)
    if values[0] > MIN_SINGULAR_RATIO * values[-1]:
        return
    weakest = basis @ vectors[:, 0]
    order = np.argsort(-np.abs(weakest), kind="stable")[:MAX_NAMED_PARAMETERS]
    raise UndeterminedParameters(
        "the readings leave a combination of parameters open, mainly "
        f"{', '.join(names[index] for index in order)} (eigenvalue ratio "
        f"{max(values[0], 0.0) / values[-1]:.1e}, at least {MIN_SINGULAR_RATIO:g} is needed); add "
        "poses that differ in position and orientation, or a length",
        parameters=tuple(names[index] for index in order),
    )


def _datum(state: AdjustmentState, size: int) -> Array:
    cameras = CameraStack.of(state.models)
    points, weights = [], []
    for poses in state.pose_sets:
        points.append(poses.marker_positions().reshape(-1, 3))
        weight = np.where(poses.seen, 1.0 / poses.sigma_px, 0.0)
        weights.append(weight.reshape(-1, weight.shape[-1]))
    datum = inner_constraints(cameras, np.concatenate(points), np.concatenate(weights))
    full = np.zeros((size, 6))
    full[: len(datum)] = datum
    return full


def _names(state: AdjustmentState, adjusted_parameters: NDArray[np.bool_]) -> list[str]:
    names = [f"{model.name} {name}" for model in state.models for name in model.parameter_names]
    for number, poses in enumerate(state.pose_sets):
        names += [f"shape of set {number + 1}"] * poses.shape.unknowns
    return [name for name, used in zip(names, adjusted_parameters, strict=True) if used]
