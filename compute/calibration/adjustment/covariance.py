"""The covariance of an adjustment's globals, and whether the readings determine them."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.adjustment.equations import (
    NormalEquations,
    ReducedEquations,
    State,
    build,
)
from compute.calibration.adjustment.gauge import (
    centring,
    cloud_datum,
    complement,
    rigid_motion_slopes,
)
from compute.calibration.adjustment.poses import PoseSet
from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.errors import UndeterminedParameters

Array = NDArray[np.float64]

DETERMINED_RATIO: Final = 1e-11
"""Smallest eigenvalue of the globals' normal matrix with a diagonal of 1, of the largest, that
is told from rounding: a parameter combination 3e5 times less certain than the best."""
NAMED: Final = 4
"""Parameters that a message names of an open combination."""


def check_poses(state: State, equations: NormalEquations) -> None:
    """Raise UndeterminedParameters for the first pose that its readings do not determine."""
    for number, block in enumerate(equations.blocks):
        open_ = np.flatnonzero(_open(block.normal))
        if len(open_):
            pose = int(open_[0])
            seen = int(state.pose_sets[number].seen[pose].sum())
            raise UndeterminedParameters(
                f"pose {pose + 1} (set {number + 1}) is not determined by its {seen} readings; "
                "leave it out",
                pose=pose + 1,
                readings=seen,
            )


def undetermined_poses(models: Sequence[SensorModel], poses: PoseSet) -> NDArray[np.bool_]:
    """Return which poses their readings do not determine, shape (B,)."""
    weights = np.ones(poses.readings_px.shape)
    return _open(build(State(tuple(models), (poses,)), [weights], None).blocks[0].normal)


def _open(normal: Array) -> NDArray[np.bool_]:
    """Return which matrices (B, d, d) are as good as singular."""
    diagonal = np.sqrt(np.maximum(np.einsum("bii->bi", normal), 1e-300))
    scaled = normal / (diagonal[:, :, None] * diagonal[:, None])
    return np.asarray(~(np.linalg.eigvalsh(scaled)[:, 0] > DETERMINED_RATIO))


def global_covariance(
    state: State,
    reduced: ReducedEquations,
    varied: NDArray[np.bool_],
    free_frame: bool,
    spread: NormalEquations | None,
) -> Array:
    """Return the covariance of the globals, shape (F, F); 0 for those not varied.

    Args:
        state: the solution.
        reduced: its undamped equations.
        varied: which globals were adjusted.
        free_frame: see ``adjust``.
        spread: with a robust loss, the equations with the variances of the loss's slopes as
            weights; None: least squares.

    Raises:
        UndeterminedParameters: a combination of parameters is open.
    """
    if not varied.any():
        return np.zeros((len(varied), len(varied)))
    sensors = sum(model.parameter_count for model in state.models)
    middle = np.concatenate(
        [poses.marker_positions().reshape(-1, 3) for poses in state.pose_sets]
    ).mean(axis=0)
    centre = np.eye(len(varied))
    centre[:sensors, :sensors] = centring(state.models, middle)
    back = np.linalg.inv(centre)
    # What is held is held in the user's frame: the columns of those that vary.
    change = back if varied.all() else np.eye(len(varied))[:, varied]
    normal = change.T @ reduced.normal @ change
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(normal), 1e-300))
    scaled = normal * scale[:, None] * scale
    motion = None
    if free_frame:
        motion = np.zeros((len(varied), 6))
        motion[:sensors] = rigid_motion_slopes(state.models)
        motion = centre @ motion / scale[:, None]
    _check_determined(scaled, motion, _names(state, varied))
    if free_frame:
        basis = complement(scale[:, None] * (change.T @ _datum(state, len(varied))))
    else:
        basis = np.eye(len(scaled))
    inverse = basis @ np.linalg.inv(basis.T @ scaled @ basis) @ basis.T
    cofactor = change @ (inverse * scale[:, None] * scale) @ change.T
    if spread is not None:
        cofactor = cofactor @ _carried(spread, reduced) @ cofactor
    covariance: Array = 0.5 * (cofactor + cofactor.T)
    return covariance


def _carried(spread: NormalEquations, reduced: ReducedEquations) -> Array:
    """Return the variance of the reduced gradient, shape (F, F)."""
    total = spread.normal.copy()
    for block, carried in zip(spread.blocks, reduced.towards, strict=True):
        crossed = np.einsum("bfd,bdg->fg", block.mixed, carried, optimize=True)
        total -= crossed + crossed.T
        total += np.einsum("bdf,bde,beg->fg", carried, block.normal, carried, optimize=True)
    return total


def _check_determined(scaled: Array, motion: Array | None, names: Sequence[str]) -> None:
    basis = np.eye(len(scaled)) if motion is None else complement(motion)
    values, vectors = np.linalg.eigh(basis.T @ scaled @ basis)
    if values[0] > DETERMINED_RATIO * values[-1]:
        return
    weakest = basis @ vectors[:, 0]
    order = np.argsort(-np.abs(weakest), kind="stable")[:NAMED]
    raise UndeterminedParameters(
        "the readings leave a combination of parameters open, mainly "
        f"{', '.join(names[index] for index in order)} (eigenvalue ratio "
        f"{max(values[0], 0.0) / values[-1]:.1e}, at least {DETERMINED_RATIO:g} is needed); add "
        "poses that differ in place and direction, or a length",
        parameters=tuple(names[index] for index in order),
    )


def _datum(state: State, size: int) -> Array:
    cameras = CameraStack.of(state.models)
    points, weights = [], []
    for poses in state.pose_sets:
        points.append(poses.marker_positions().reshape(-1, 3))
        weight = np.where(poses.seen, 1.0 / poses.sigma_px, 0.0)
        weights.append(weight.reshape(-1, weight.shape[-1]))
    datum = cloud_datum(cameras, np.concatenate(points), np.concatenate(weights))
    full = np.zeros((size, 6))
    full[: len(datum)] = datum
    return full


def _names(state: State, varied: NDArray[np.bool_]) -> list[str]:
    names = [f"{model.name} {name}" for model in state.models for name in model.parameter_names]
    for number, poses in enumerate(state.pose_sets):
        names += [f"shape of set {number + 1}"] * poses.shape.freedom
    return [name for name, used in zip(names, varied, strict=True) if used]
