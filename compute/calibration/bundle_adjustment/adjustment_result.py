"""AdjustmentResult: solution of a bundle adjustment, its covariance, what is undetermined."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.gauge import (
    inner_constraints,
    orthogonal_complement,
    rigid_motion_jacobian,
    shift_origins,
)
from compute.calibration.bundle_adjustment.normal_equations import (
    AdjustmentState,
    NormalEquations,
    ReducedEquations,
    build_normal_equations,
    loss_weights,
    total_loss,
)
from compute.calibration.bundle_adjustment.pose_set import PoseSet
from compute.calibration.bundle_adjustment.sensor_prior import SensorPrior
from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.errors import UndeterminedParameters

Array = NDArray[np.float64]

MIN_SINGULAR_RATIO: Final = 1e-11
"""Smallest eigenvalue of the globals' normal matrix with a diagonal of 1, of the largest, that
is distinguishable from rounding: a parameter combination 3e5 times less certain than the best."""
MAX_NAMED_PARAMETERS: Final = 4
"""Parameters that a message names of an open combination."""


@dataclass(frozen=True, eq=False)
class AdjustmentResult:
    """Least-squares (or robust) estimate of sensors, shapes and poses.

    Args:
        models: the sensors.
        pose_sets: the poses, with their shapes.
        global_covariance: of the sensors' parameters, in the order of
            ``SensorModel.parameter_names``, then of the shapes' unknowns, shape (F, F). For the
            readings' standard deviations as given; held parameters are 0.
        residuals: (fitted - read) / sigma of each set, (B, K, S); NaN where not seen.
        weights: 1, and less for readings beyond the robust loss's limit, (B, K, S).
        chi2: sum of squared residuals, of those that count fully, with the priors'.
        dof: readings that count fully, and priors, less unknowns.
        iterations: steps that were tried.
    """

    models: tuple[SensorModel, ...]
    pose_sets: tuple[PoseSet, ...]
    global_covariance: Array
    residuals: tuple[Array, ...]
    weights: tuple[Array, ...]
    chi2: float
    dof: int
    iterations: int
    _reduced: ReducedEquations

    @property
    def sensor_covariance(self) -> Array:
        """Joint covariance of the sensors' parameters, shape (P, P)."""
        count = sum(model.parameter_count for model in self.models)
        return self.global_covariance[:count, :count]

    def eliminated(self, index: int = 0) -> tuple[Array, Array]:
        """Return V^-1 (B, d, d) and V^-1 W' (B, d, F) of one set's normal equations."""
        return self._reduced.inverses[index], self._reduced.back_substitution[index]

    def pose_covariance(self, index: int = 0) -> Array:
        """Return the covariances of one set's poses, the sensors' uncertainty included.

        Shape (B, d, d), in the order of a pose's unknowns: rotations [rad], then translation [mm].
        """
        carried = self._reduced.back_substitution[index]
        covariance: Array = self._reduced.inverses[index] + np.einsum(
            "bif,fg,bjg->bij", carried, self.global_covariance, carried, optimize=True
        )
        return covariance

    def pose_sensor_covariance(self, index: int = 0) -> Array:
        """Return the covariances between one set's poses and the globals, shape (B, d, F)."""
        return np.asarray(-self._reduced.back_substitution[index] @ self.global_covariance)


def assemble_result(
    state: AdjustmentState,
    residuals: Sequence[Array],
    prior: SensorPrior | None,
    adjusted_parameters: NDArray[np.bool_],
    *,
    limit: float,
    free_datum: bool,
    iterations: int,
) -> AdjustmentResult:
    """Return the result of an adjustment with its covariance and statistics.

    Args:
        state: the solution.
        residuals: over sigma, shape (B, K, S) for each pose set.
        prior: of the sensors' parameters, or None.
        adjusted_parameters: which globals were adjusted, shape (F,).
        limit: Huber's limit of the loss; inf: least squares.
        free_datum: see ``adjust``.
        iterations: number of trial steps.

    Raises:
        UndeterminedParameters: the readings do not determine a pose or a combination of
            parameters.
    """
    weights = loss_weights(residuals, limit)
    equations = build_normal_equations(state, weights, prior)
    _check_poses(state, equations)
    reduced = equations.reduced()
    noise_equations = None
    if any((one < 1.0).any() for one in weights):
        variances = [np.where(one < 1.0, limit**2, 1.0) for one in weights]
        noise_equations = build_normal_equations(state, variances, prior)
    covariance = _global_covariance(
        state, reduced, adjusted_parameters, free_datum, noise_equations
    )
    full = [
        (one >= 1.0) & poses.observed_mask
        for one, poses in zip(weights, state.pose_sets, strict=True)
    ]
    chi2 = total_loss(
        state,
        [np.where(use, one, 0.0) for use, one in zip(full, residuals, strict=True)],
        prior,
        np.inf,
    )
    equations_count = sum(int(use.sum()) for use in full)
    for poses in state.pose_sets:
        equations_count += len(poses.shape.equations()[0]) + (
            3 * len(poses) if poses.prior() else 0
        )
    if prior is not None:
        equations_count += int(np.linalg.matrix_rank(prior.information, hermitian=True))
    unknown = int(adjusted_parameters.sum()) - (6 if free_datum else 0)
    unknown += sum(len(poses) * poses.unknowns for poses in state.pose_sets)
    return AdjustmentResult(
        state.models,
        state.pose_sets,
        covariance,
        tuple(
            np.where(poses.observed_mask, one, np.nan)
            for poses, one in zip(state.pose_sets, residuals, strict=True)
        ),
        tuple(weights),
        chi2,
        equations_count - unknown,
        iterations,
        reduced,
    )


def _check_poses(state: AdjustmentState, equations: NormalEquations) -> None:
    for number, block in enumerate(equations.blocks):
        for pose in np.flatnonzero(_is_singular(block.normal)).tolist():
            readings = int(state.pose_sets[number].observed_mask[pose].sum())
            raise UndeterminedParameters(
                f"pose {pose + 1} (set {number + 1}) is not determined by its {readings} readings; "
                "leave it out",
                pose=pose + 1,
                readings=readings,
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


def _global_covariance(
    state: AdjustmentState,
    reduced: ReducedEquations,
    adjusted_parameters: NDArray[np.bool_],
    free_datum: bool,
    noise_equations: NormalEquations | None,
) -> Array:
    """Return the covariance of the global parameters, shape (F, F); 0 for held ones.

    With a robust loss, ``noise_equations`` are weighted by the variance of the loss's derivative.
    """
    if not adjusted_parameters.any():
        return np.zeros((len(adjusted_parameters), len(adjusted_parameters)))
    sensors = sum(model.parameter_count for model in state.models)
    centroid = np.concatenate(
        [poses.marker_positions().reshape(-1, 3) for poses in state.pose_sets]
    ).mean(axis=0)
    centre = np.eye(len(adjusted_parameters))
    shifts = [model.rotation @ centroid for model in state.models]
    centre[:sensors, :sensors] = shift_origins(state.models, shifts)
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
        motion = rigid_motion_jacobian(state.models, len(adjusted_parameters))
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
    return np.asarray(0.5 * (cofactor + cofactor.T))


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
        weight = np.where(poses.observed_mask, 1.0 / poses.sigma_px, 0.0)
        weights.append(weight.reshape(-1, weight.shape[-1]))
    datum = inner_constraints(cameras, np.concatenate(points), np.concatenate(weights))
    return np.pad(datum, ((0, size - len(datum)), (0, 0)))


def _names(state: AdjustmentState, adjusted_parameters: NDArray[np.bool_]) -> list[str]:
    names = [f"{model.name} {name}" for model in state.models for name in model.parameter_names]
    for number, poses in enumerate(state.pose_sets):
        names += [f"shape of set {number + 1}"] * poses.shape.unknowns
    return [name for name, used in zip(names, adjusted_parameters, strict=True) if used]
