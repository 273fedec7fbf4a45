"""Gauge freedom of a free network: rigid motions of the world and inner constraints."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack

Array = NDArray[np.float64]


def rigid_motion_jacobian(models: Sequence[SensorModel], size: int = 0) -> Array:
    """Return d parameters / d (rotation, translation) of the world, shape (P, 6).

    For ``X <- X + w x X + t`` with cameras whose readings of the moved points do not change.

    Args:
        models: the cameras, with P parameters in all.
        size: number of rows if there are other unknowns, which do not change: theirs are 0.
    """
    blocks = []
    for model in models:
        block = np.zeros((model.parameter_count, 6))
        block[2:5, :3] = -model.rotation
        block[5, 3:], block[6, 3:] = -model.rotation[0], -model.rotation[2]
        if model.distortion is not None:
            block[7, 3:] = -model.rotation[1]
        blocks.append(block)
    jacobian = np.concatenate(blocks)
    return np.pad(jacobian, ((0, max(size - len(jacobian), 0)), (0, 0)))


def transform_world(model: SensorModel, rotation: Array, translation_mm: Array) -> SensorModel:
    """Return a camera after a rigid motion of the world; its readings do not change.

    Args:
        model: the camera before ``X <- rotation X + translation``.
        rotation: shape (3, 3).
        translation_mm: shape (3,) [mm].
    """
    rotated = model.rotation @ rotation.T
    shift = rotated @ translation_mm
    x, y, z = Rotation.from_matrix(rotated).as_rotvec().tolist()
    distortion = model.distortion
    if distortion is not None:
        distortion = replace(distortion, offset_y_mm=distortion.offset_y_mm - float(shift[1]))
    return replace(
        model,
        rotation_vector_rad=(x, y, z),
        offset_x_mm=model.offset_x_mm - float(shift[0]),
        offset_z_mm=model.offset_z_mm - float(shift[2]),
        distortion=distortion,
    )


def inner_constraints(cameras: CameraStack, points_mm: Array, weights: Array) -> Array:
    """Return the inner constraints D of a free network, ``D' dp = 0``, shape (P, 6).

    They hold the cloud of points in its place: where the unchanged cameras would fit its readings
    best if it moved as a rigid body. With A the Jacobian of readings by points, M of points by a
    rigid motion and J of readings by parameters, that is ``M'A' W J dp = 0``.

    Args:
        cameras: S cameras.
        points_mm: shape (N, 3) [mm].
        weights: 1 / standard deviation of the readings, 0 where not seen, shape (N, S) [1/px].
    """
    _, jacobian = cameras.linearise(points_mm)
    whitened = np.nan_to_num(jacobian) * weights[..., None]
    by_parameter = np.nan_to_num(cameras.parameter_jacobian(points_mm)) * weights[..., None]
    arms = points_mm - points_mm.mean(axis=0)
    # A rotation w about the centroid moves a point by w x arm, its readings by (arm x slope).w
    rotated = np.cross(arms[:, None], whitened)
    by_motion = np.concatenate([rotated, whitened], axis=2)
    datum = np.einsum("nsm,nsp->msp", by_motion, by_parameter).reshape(6, -1)
    return np.ascontiguousarray(gather_parameters(cameras, datum).T)


def gather_parameters(cameras: CameraStack, values: Array) -> Array:
    """Return values by all parameters in the order of the cameras' joint covariance.

    Args:
        cameras: S cameras with P parameters in all.
        values: by each camera and parameter of the stack, shape (..., S * width).

    Returns:
        Shape (..., P).
    """
    present = np.flatnonzero(cameras.parameter_mask)
    gathered = np.empty((*values.shape[:-1], len(present)))
    gathered[..., cameras.parameter_index.ravel()[present]] = values[..., present]
    return gathered


def shift_origins(models: Sequence[SensorModel], shifts_mm: Sequence[Array]) -> Array:
    """Return T, shape (P, P), from steps of cameras to steps about other origins.

    Seen from the centre of the measured volume, rotations and translations of a camera correlate
    least.

    Args:
        models: the cameras, with P parameters in all.
        shifts_mm: for each, the new origin less the old in its own frame, shape (3,) [mm].
    """
    change = np.eye(sum(model.parameter_count for model in models))
    first = 0
    for model, shift in zip(models, shifts_mm, strict=True):
        a, b, c = shift.tolist()
        # d(offset + R m) = d offset + w x (R m)
        change[first + 5, first + 2 : first + 5] = (0.0, c, -b)
        change[first + 6, first + 2 : first + 5] = (b, -a, 0.0)
        if model.distortion is not None:
            change[first + 7, first + 2 : first + 5] = (-c, 0.0, a)
        first += model.parameter_count
    return change


def orthogonal_complement(columns: Array) -> Array:
    """Return an orthonormal basis of the orthogonal complement of some columns."""
    basis, _ = np.linalg.qr(columns, mode="complete")
    return np.asarray(basis[:, columns.shape[1] :])
