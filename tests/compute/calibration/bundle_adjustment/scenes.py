"""Poses of points, bars and bodies in front of the rig, with readings."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from compute.calibration.bundle_adjustment.pose_set import PoseSet
from compute.calibration.bundle_adjustment.target_shape import TargetShape
from compute.camera.field_distortion import FieldDistortion
from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from tests.compute.rig import rig

Array = NDArray[np.float64]

SIGMA_PX = 0.1
MIDDLE = np.array([0.0, 0.0, 1500.0])
BODY = np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [0.0, 70.0, 0.0], [20.0, 30.0, 60.0]])
TERMS = ((3, 0), (1, 2))


def distorted_rig() -> tuple[SensorModel, ...]:
    """The rig, two of its sensors with distortion, of different terms."""
    first, second, third, fourth = rig()
    lens = FieldDistortion(TERMS, (-0.4, -0.6), 30.0, 12.0)
    return (
        first,
        replace(second, distortion=lens),
        third,
        replace(fourth, distortion=FieldDistortion(TERMS[:1], (0.3,), -20.0)),
    )


def posed(
    shape: TargetShape,
    poses: int,
    rng: np.random.Generator,
    models: tuple[SensorModel, ...],
    half_mm: float = 120.0,
    noise_px: float = SIGMA_PX,
) -> PoseSet:
    """The shape at random poses, with readings of its markers."""
    empty = np.zeros((poses, len(shape), len(models)))
    true = PoseSet(
        shape,
        MIDDLE + rng.uniform(-half_mm, half_mm, (poses, 3)),
        Rotation.random(poses, rng=rng).as_matrix(),
        empty,
        np.full_like(empty, SIGMA_PX),
    )
    exact = CameraStack.of(models).project(true.marker_positions().reshape(-1, 3))
    read = exact.reshape(empty.shape) + noise_px * rng.standard_normal(empty.shape)
    return replace(true, readings_px=read)


def nudged(poses: PoseSet, rng: np.random.Generator, size: float = 1.0) -> PoseSet:
    """The poses a little off: a millimetre, and a hundredth of a radian."""
    step = size * rng.standard_normal((len(poses), poses.unknowns))
    step[:, :-3] *= 0.01
    return poses.retract(step)


def nudged_models(
    models: tuple[SensorModel, ...], rng: np.random.Generator, size: float = 1.0
) -> tuple[SensorModel, ...]:
    """The sensors a little off."""
    scale = np.array([20.0, 5.0, 0.005, 0.005, 0.005, 2.0, 5.0, 2.0, 0.05, 0.05])
    return tuple(
        model.retract(
            size * scale[: model.parameter_count] * rng.standard_normal(model.parameter_count)
        )
        for model in models
    )
