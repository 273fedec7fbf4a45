"""Normal equations of a bundle adjustment: assembly, and reduction by Schur complement."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.pose_set import PoseSet
from compute.calibration.bundle_adjustment.sensor_prior import SensorPrior
from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack

Array = NDArray[np.float64]


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
        found = []
        for poses in self.pose_sets:
            projected = cameras.project(poses.marker_positions().reshape(-1, 3))
            difference = projected.reshape(poses.readings_px.shape) - poses.readings_px
            found.append(np.where(poses.seen, difference / poses.sigma_px, 0.0))
        return found

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
    present = np.flatnonzero(cameras.parameter_mask)
    order = cameras.parameter_index.ravel()[present]
    count = len(present)
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
        marker = poses.marker_positions().reshape(-1, 3)
        projected, position_jacobian = cameras.linearise(marker)
        full = (*poses.readings_px.shape, -1)
        scale = np.where(poses.seen, np.sqrt(weight) / poses.sigma_px, 0.0)
        residual = np.where(
            poses.seen, (projected.reshape(full[:-1]) - poses.readings_px) * scale, 0.0
        )
        inverse_sigma = scale[..., None]
        globals_ = np.nan_to_num(cameras.parameter_jacobian(marker)).reshape(full) * inverse_sigma
        weighted_position_jacobian = np.nan_to_num(position_jacobian).reshape(full) * inverse_sigma
        local = weighted_position_jacobian @ poses.marker_jacobian()  # (B, K, S, 3) @ (B, K, 3, d)
        sensor_normal += np.einsum("bksp,bksq->spq", globals_, globals_, optimize=True)
        sensor_gradient += np.einsum("bksp,bks->sp", globals_, residual)

        flat = local.reshape(len(poses), -1, poses.unknowns)
        transposed = flat.transpose(0, 2, 1)
        block_normal = transposed @ flat
        block_gradient = (transposed @ residual.reshape(len(poses), -1, 1))[..., 0]
        # (B, S, width, K) @ (B, S, K, d)
        crossed = globals_.transpose(0, 2, 3, 1) @ local.transpose(0, 2, 1, 3)
        mixed = np.zeros((len(poses), size, poses.unknowns))
        mixed[:, order] = crossed.reshape(len(poses), sensors * width, -1)[:, present]
        if poses.shape.unknowns:
            changes = np.einsum("bij,mkj->bkim", poses.rotation, poses.shape.basis)
            shape_jacobian = weighted_position_jacobian @ changes  # (B, K, S, M)
            rows = shape_jacobian.reshape(-1, poses.shape.unknowns)
            normal[shape, shape] += rows.T @ rows
            gradient[shape] += rows.T @ residual.ravel()
            with_sensors = np.einsum("bksp,bksm->spm", globals_, shape_jacobian, optimize=True)
            part = np.zeros((count, poses.shape.unknowns))
            part[order] = with_sensors.reshape(sensors * width, -1)[present]
            normal[:count, shape] += part
            normal[shape, :count] += part.T
            mixed[:, shape] = shape_jacobian.reshape(*flat.shape[:2], -1).transpose(0, 2, 1) @ flat
        known, known_jacobian = poses.shape.equations()
        normal[shape, shape] += known_jacobian.T @ known_jacobian
        gradient[shape] += known_jacobian.T @ known
        pose_prior = poses.prior()
        if pose_prior is not None:
            difference, information = pose_prior
            block_normal[:, -3:, -3:] += information
            block_gradient[:, -3:] += np.einsum("bij,bj->bi", information, difference)
        blocks.append(PoseBlocks(block_normal, mixed, block_gradient))

    together = np.zeros((sensors, width, sensors, width))
    index = np.arange(sensors)
    together[index, :, index] = sensor_normal
    square = together.reshape(sensors * width, -1)[np.ix_(present, present)]
    normal[np.ix_(order, order)] += square
    gradient[order] += sensor_gradient.ravel()[present]
    if prior is not None:
        difference, prior_jacobian = prior.difference(state.models)
        normal[:count, :count] += prior_jacobian.T @ prior.information @ prior_jacobian
        gradient[:count] += prior_jacobian.T @ prior.information @ difference
    return NormalEquations(normal, gradient, tuple(blocks))
