"""World frame (datum) of a self-calibration: the start's, or that of the first pose."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from compute.calibration.bundle_adjustment.adjustment_result import AdjustmentResult
from compute.calibration.bundle_adjustment.gauge import (
    rigid_motion_jacobian,
    shift_origins,
    transform_world,
)
from compute.calibration.bundle_adjustment.pose_set import PoseSet
from compute.calibration.bundle_adjustment.solver import adjust
from compute.calibration.bundle_adjustment.target_shape import body_shape
from compute.camera.model import SensorModel
from compute.errors import NoConvergence

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class DatumResult:
    """Sensors and poses in their world frame, with the sensors' covariance there.

    Args:
        models: the sensors.
        pose_sets: the poses.
        covariance: of the sensors' parameters, shape (P, P).
    """

    models: tuple[SensorModel, ...]
    pose_sets: tuple[PoseSet, ...]
    covariance: Array


def to_start_frame(adjusted: AdjustmentResult, start: Sequence[SensorModel]) -> DatumResult:
    """Transform the result to the frame of the starting cameras.

    All markers together, as one rigid cloud, are fitted to the readings with the starting cameras
    held. An error of the start may rotate the frame, but does not deform it.

    Args:
        adjusted: the adjustment.
        start: the S starting cameras.
    """
    marker, reading, sigma = [], [], []
    for poses in adjusted.pose_sets:
        marker.append(poses.marker_positions().reshape(-1, 3))
        reading.append(poses.readings_px.reshape(-1, poses.readings_px.shape[-1]))
        sigma.append(poses.sigma_px.reshape(reading[-1].shape))
    markers = np.concatenate(marker)
    rotation, translation = _rigid_motion_between(adjusted.models, start)
    centre = markers.mean(axis=0)
    cloud = PoseSet(
        body_shape(markers),
        (rotation @ centre + translation)[None],
        rotation[None],
        np.concatenate(reading)[None],
        np.concatenate(sigma)[None],
    )
    held = np.zeros(sum(model.parameter_count for model in start), dtype=np.bool_)
    fitted = cloud
    # With bad lenses the cloud may lie behind one: keep the rigid motion between the cameras.
    with suppress(NoConvergence):
        fitted = adjust(start, [cloud], free=held).pose_sets[0]
    rotation = fitted.rotation[0]
    translation = fitted.translation_mm[0] - rotation @ centre
    return _transform(adjusted, adjusted.sensor_covariance, rotation, translation)


def to_first_pose_frame(
    adjusted: AdjustmentResult, origin_mm: Array, index: int = 0, pose: int = 0
) -> DatumResult:
    """Transform the result to the frame of one pose of one set.

    Args:
        adjusted: the adjustment.
        origin_mm: origin of the set's shape, its centroid, in the frame wanted, shape (3,) [mm].
        index: the set.
        pose: the pose in it.
    """
    poses = adjusted.pose_sets[index]
    rotation = poses.rotation[pose].T
    translation = origin_mm - rotation @ poses.translation_mm[pose]
    count = len(adjusted.sensor_covariance)
    motion = rigid_motion_jacobian(adjusted.models)
    # Jacobian of the pose's unknowns (rotations, translation) by a motion of the world.
    pose_motion = np.zeros((6, 6))
    pose_motion[:3, :3] = rotation
    x, y, z = poses.translation_mm[pose].tolist()
    pose_motion[3:, :3] = -np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    pose_motion[3:, 3:] = np.eye(3)
    camera_motion = motion @ np.linalg.inv(pose_motion)
    crossed = adjusted.pose_sensor_covariance(index)[pose][:, :count]
    crossed_motion = camera_motion @ crossed
    covariance = (
        adjusted.sensor_covariance
        - crossed_motion
        - crossed_motion.T
        + camera_motion @ adjusted.pose_covariance(index)[pose] @ camera_motion.T
    )
    return _transform(adjusted, covariance, rotation, translation)


def align_to_start(
    models: Sequence[SensorModel], start: Sequence[SensorModel]
) -> tuple[SensorModel, ...]:
    """Move cameras as one rigid device to where they are closest to the start's.

    The frame of a free adjustment drifts; priors of the cameras are in the start's frame.

    Args:
        models: S cameras.
        start: the S starting cameras.
    """
    rotation, translation = _rigid_motion_between(models, start)
    return tuple(transform_world(model, rotation, translation) for model in models)


def rotation_between(models: Sequence[SensorModel], start: Sequence[SensorModel]) -> Array:
    """Return the rotation of the world that brings cameras closest to those of the start, (3, 3).

    Args:
        models: S cameras.
        start: the S starting cameras.
    """
    rotations = np.array(
        [given.rotation.T @ found.rotation for found, given in zip(models, start, strict=True)]
    )
    return np.asarray(Rotation.from_matrix(rotations).mean().as_matrix())


def _rigid_motion_between(
    models: Sequence[SensorModel], start: Sequence[SensorModel]
) -> tuple[Array, Array]:
    """Return the rigid motion that brings cameras closest to those of the start."""
    rotation = rotation_between(models, start)
    # The lens is known except for its offset along the slit: two equations a camera.
    rows, right = [], []
    for found, given in zip(models, start, strict=True):
        turned = found.rotation @ rotation.T
        rows += [turned[0], turned[2]]
        right += [found.offset_x_mm - given.offset_x_mm, found.offset_z_mm - given.offset_z_mm]
    translation = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]
    return rotation, np.asarray(translation, dtype=np.float64)


def _transform(
    adjusted: AdjustmentResult, covariance: Array, rotation: Array, translation_mm: Array
) -> DatumResult:
    """Return sensors and poses after ``X <- rotation X + translation``.

    Rotations are steps in a camera's own frame and do not change; the offsets become ``o - R' t``
    with ``R' = R rotation'``, which rotates with the camera.
    """
    models = adjusted.models
    change = shift_origins(models, [-(m.rotation @ rotation.T @ translation_mm) for m in models])
    return DatumResult(
        tuple(transform_world(model, rotation, translation_mm) for model in models),
        tuple(poses.transformed(rotation, translation_mm) for poses in adjusted.pose_sets),
        change @ covariance @ change.T,
    )
