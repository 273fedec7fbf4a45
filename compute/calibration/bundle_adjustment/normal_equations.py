"""State, loss and normal equations of a bundle adjustment, with their Schur complement."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.gauge import gather_parameters
from compute.calibration.bundle_adjustment.pose_set import PoseSet
from compute.calibration.bundle_adjustment.sensor_prior import SensorPrior
from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.robust_statistics import MAD_TO_SIGMA

Array = NDArray[np.float64]

HUBER_LIMIT: Final = 3.0
"""Residual, in standard deviations, beyond which it counts by its size and not by its square
(Huber, doi:10.1214/aoms/1177703732): of good readings 0.3 % lie beyond, so that the covariance is
that of least squares; an outlier has no more influence than a residual of three standard
deviations."""


@dataclass(frozen=True, eq=False)
class AdjustmentState:
    """Current values of an adjustment.

    Args:
        models: the sensors.
        pose_sets: the targets' shapes and poses, with their readings.
    """

    models: tuple[SensorModel, ...]
    pose_sets: tuple[PoseSet, ...]

    def residuals(self) -> list[Array]:
        """Return (projected - read) / sigma of each set, (B, K, S).

        0 where not seen, NaN where a marker that was read lies behind the lens.
        """
        cameras = CameraStack.of(self.models)
        residuals = []
        for poses in self.pose_sets:
            projected = cameras.project(poses.marker_positions().reshape(-1, 3))
            difference = projected.reshape(poses.readings_px.shape) - poses.readings_px
            residuals.append(np.where(poses.observed_mask, difference / poses.sigma_px, 0.0))
        return residuals

    def retract(self, step: Array, local: Sequence[Array]) -> "AdjustmentState":
        """Return the state after a step.

        Args:
            step: of the globals, shape (F,).
            local: of the poses, shape (B, d) for each set.
        """
        models = []
        first = 0
        for model in self.models:
            models.append(model.retract(step[first : first + model.parameter_count]))
            first += model.parameter_count
        pose_sets = []
        for poses, one in zip(self.pose_sets, local, strict=True):
            after = poses.retract(one)
            if poses.shape.unknowns:
                shape = poses.shape.retract(step[first : first + poses.shape.unknowns])
                after = replace(after, shape=shape)
                first += poses.shape.unknowns
            pose_sets.append(after)
        return AdjustmentState(tuple(models), tuple(pose_sets))


@dataclass(frozen=True, eq=False)
class PoseBlocks:
    """One pose set's blocks of the normal equations.

    Args:
        normal: V of each pose, shape (B, d, d).
        mixed: W between the globals and each pose, shape (B, F, d).
        gradient: shape (B, d).
    """

    normal: Array
    mixed: Array
    gradient: Array


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Gauss-Newton equations ``N step = -gradient``, in blocks.

    The F globals are the sensors' parameters, as in ``SensorModel.parameter_names``, then each
    set's unknowns of its shape.

    Args:
        normal: of the globals, shape (F, F).
        gradient: shape (F,).
        blocks: one for each set of poses.
    """

    normal: Array
    gradient: Array
    blocks: tuple[PoseBlocks, ...]

    def reduced(self, damping: float = 0.0) -> "ReducedEquations":
        """Eliminate the poses (Schur complement); damping scales up every diagonal."""
        normal = self.normal.copy()
        _damp(normal, damping)
        gradient = self.gradient.copy()
        inverses, back_substitution = [], []
        for block in self.blocks:
            local = block.normal.copy()
            _damp(local, damping)
            inverse = np.asarray(np.linalg.inv(local), dtype=np.float64)
            # T = V^-1 W' takes globals to the poses.
            carried = inverse @ block.mixed.transpose(0, 2, 1)
            flat = carried.reshape(-1, carried.shape[-1])
            normal -= block.mixed.transpose(0, 2, 1).reshape(flat.shape).T @ flat
            gradient -= flat.T @ block.gradient.ravel()
            inverses.append(inverse)
            back_substitution.append(carried)
        return ReducedEquations(
            0.5 * (normal + normal.T), gradient, tuple(inverses), tuple(back_substitution)
        )


@dataclass(frozen=True, eq=False)
class ReducedEquations:
    """Equations of the globals after elimination of the poses, and the back-substitution.

    Args:
        normal: S, shape (F, F).
        gradient: shape (F,).
        inverses: V^-1 of each set, (B, d, d).
        back_substitution: V^-1 W', (B, d, F).
    """

    normal: Array
    gradient: Array
    inverses: tuple[Array, ...]
    back_substitution: tuple[Array, ...]

    def local_steps(self, equations: NormalEquations, step: Array) -> list[Array]:
        """Return the poses' steps by back-substitution, (B, d) for each set.

        Args:
            equations: the equations before elimination.
            step: step of the globals, shape (F,).
        """
        return [
            -np.einsum("bij,bj->bi", inverse, block.gradient) - carried @ step
            for inverse, carried, block in zip(
                self.inverses, self.back_substitution, equations.blocks, strict=True
            )
        ]


def _damp(normal: Array, damping: float) -> None:
    """Damp the diagonals of matrices (..., n, n) in place; an empty row gets a 1."""
    if damping == 0.0:
        return
    diagonal_index = np.arange(normal.shape[-1])
    diagonal = normal[..., diagonal_index, diagonal_index]
    normal[..., diagonal_index, diagonal_index] += np.where(diagonal > 0.0, damping * diagonal, 1.0)


@dataclass(frozen=True, eq=False)
class WhitenedJacobians:
    """Readings of one pose set and their Jacobians, over their standard deviations.

    Args:
        projected_px: readings of the cameras, shape (B, K, S) [px], not over sigma.
        by_parameter: by the cameras' parameters, shape (B, K, S, width).
        by_pose: by the poses' unknowns, shape (B, K, S, d).
        by_shape: by the unknowns of the shape, shape (B, K, S, M).
    """

    projected_px: Array
    by_parameter: Array
    by_pose: Array
    by_shape: Array

    @classmethod
    def of(cls, cameras: CameraStack, poses: PoseSet, weight: Array) -> "WhitenedJacobians":
        """Linearise the readings.

        Args:
            cameras: S cameras.
            poses: B poses of K markers.
            weight: 1 / standard deviation, shape (B, K, S) [1/px]; 0: not seen.
        """
        marker = poses.marker_positions().reshape(-1, 3)
        full = (*poses.readings_px.shape, -1)
        scale = weight[..., None]
        projected, by_position = cameras.linearise(marker)
        by_position = np.nan_to_num(by_position).reshape(full) * scale
        # (B, K, S, 3) @ (B, K, 3, unknowns)
        return cls(
            projected.reshape(full[:-1]),
            np.nan_to_num(cameras.parameter_jacobian(marker)).reshape(full) * scale,
            by_position @ poses.marker_jacobian(),
            by_position @ np.einsum("bij,mkj->bkim", poses.rotation, poses.shape.basis),
        )


def build_normal_equations(
    state: AdjustmentState, weights: Sequence[Array], prior: SensorPrior | None
) -> NormalEquations:
    """Assemble the normal equations at a state.

    Args:
        state: sensors and poses, every marker that was read in front of the lenses.
        weights: factors for the squared residuals, (B, K, S) for each set.
        prior: of the sensors.
    """
    cameras = CameraStack.of(state.models)
    count = int(cameras.parameter_mask.sum())
    size = count + sum(poses.shape.unknowns for poses in state.pose_sets)
    normal, gradient = np.zeros((size, size)), np.zeros(size)
    sensors, width = cameras.parameter_index.shape
    sensor_normal = np.zeros((sensors, width, width))
    sensor_gradient = np.zeros((sensors, width))
    blocks = []
    first = count
    for poses, weight in zip(state.pose_sets, weights, strict=True):
        shape = slice(first, first + poses.shape.unknowns)
        first = shape.stop
        scale = np.where(poses.observed_mask, np.sqrt(weight) / poses.sigma_px, 0.0)
        at = WhitenedJacobians.of(cameras, poses, scale)
        residual = np.where(poses.observed_mask, (at.projected_px - poses.readings_px) * scale, 0.0)
        sensor_normal += np.einsum(
            "bksp,bksq->spq", at.by_parameter, at.by_parameter, optimize=True
        )
        sensor_gradient += np.einsum("bksp,bks->sp", at.by_parameter, residual)

        flat = at.by_pose.reshape(len(poses), -1, poses.unknowns)
        transposed = flat.transpose(0, 2, 1)
        block_normal = transposed @ flat
        block_gradient = (transposed @ residual.reshape(len(poses), -1, 1))[..., 0]
        # (B, S, width, K) @ (B, S, K, d)
        crossed = at.by_parameter.transpose(0, 2, 3, 1) @ at.by_pose.transpose(0, 2, 1, 3)
        crossed = crossed.reshape(len(poses), sensors * width, -1).swapaxes(1, 2)
        mixed = np.zeros((len(poses), size, poses.unknowns))
        mixed[:, :count] = gather_parameters(cameras, crossed).swapaxes(1, 2)
        if poses.shape.unknowns:
            rows = at.by_shape.reshape(-1, poses.shape.unknowns)
            normal[shape, shape] += rows.T @ rows
            gradient[shape] += rows.T @ residual.ravel()
            with_sensors = np.einsum("bksp,bksm->spm", at.by_parameter, at.by_shape, optimize=True)
            part = gather_parameters(cameras, with_sensors.reshape(sensors * width, -1).T)
            normal[shape, :count] += part
            normal[:count, shape] += part.T
            mixed[:, shape] = at.by_shape.reshape(*flat.shape[:2], -1).transpose(0, 2, 1) @ flat
        constraint, constraint_jacobian = poses.shape.equations()
        normal[shape, shape] += constraint_jacobian.T @ constraint_jacobian
        gradient[shape] += constraint_jacobian.T @ constraint
        pose_prior = poses.prior()
        if pose_prior is not None:
            difference, information = pose_prior
            block_normal[:, -3:, -3:] += information
            block_gradient[:, -3:] += np.einsum("bij,bj->bi", information, difference)
        blocks.append(PoseBlocks(block_normal, mixed, block_gradient))

    together = np.zeros((sensors, width, sensors, width))
    index = np.arange(sensors)
    together[index, :, index] = sensor_normal
    square = gather_parameters(cameras, together.reshape(sensors * width, -1))
    normal[:count, :count] += gather_parameters(cameras, square.T).T
    gradient[:count] += gather_parameters(cameras, sensor_gradient.ravel())
    if prior is not None:
        difference, prior_jacobian = prior.difference(state.models)
        normal[:count, :count] += prior_jacobian.T @ prior.information @ prior_jacobian
        gradient[:count] += prior_jacobian.T @ prior.information @ difference
    return NormalEquations(normal, gradient, tuple(blocks))


def total_loss(
    state: AdjustmentState, residuals: Sequence[Array], prior: SensorPrior | None, limit: float
) -> float:
    """Return the loss of a state; NaN with an observed marker behind a lens.

    Args:
        state: sensors and poses.
        residuals: over sigma, shape (B, K, S) for each pose set.
        prior: of the sensors, or None.
        limit: beyond this residual Huber's linear loss holds; inf: squares only.
    """
    total = 0.0
    for poses, residual in zip(state.pose_sets, residuals, strict=True):
        size = np.abs(residual)
        if np.isfinite(limit):
            total += float(np.where(size <= limit, size**2, 2.0 * limit * size - limit**2).sum())
        else:
            total += float((size**2).sum())
        placed = poses.prior()
        if placed is not None:
            away, information = placed
            total += float(np.einsum("bi,bij,bj->", away, information, away))
        total += float((poses.shape.equations()[0] ** 2).sum())
    if prior is not None:
        away = prior.difference(state.models)[0]
        total += float(away @ prior.information @ away)
    return total


def loss_weights(residuals: Sequence[Array], limit: float) -> list[Array]:
    """Return the weights of iteratively reweighted least squares.

    Args:
        residuals: over sigma, shape (B, K, S) for each pose set.
        limit: Huber's limit; inf: all weights are 1.

    Returns:
        Weights, shape (B, K, S) for each set.
    """
    return [
        limit / np.maximum(np.abs(one), limit) if np.isfinite(limit) else np.ones_like(one)
        for one in residuals
    ]


def robust_scale(state: AdjustmentState, residuals: Sequence[Array]) -> float:
    """Estimate the residuals' scale from their median absolute value; at least 1.

    Args:
        state: sensors and poses.
        residuals: over sigma, shape (B, K, S) for each pose set.
    """
    measured = [r[poses.observed_mask] for r, poses in zip(residuals, state.pose_sets, strict=True)]
    together = np.abs(np.concatenate(measured))
    return max(1.0, MAD_TO_SIGMA * float(np.median(together))) if len(together) else 1.0
