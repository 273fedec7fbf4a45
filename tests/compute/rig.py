"""A rig of 1D cameras and control points that tests of the compute packages share."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from compute.camera.model import SensorGeometry, SensorModel
from compute.camera.stack import CameraStack

Array = NDArray[np.float64]

PIXELS = 2048
THIRD_LENS_MM = np.array([100.0, 40.0, 0.0])
"""The lens of the third of four sensors of ``rig``."""


def camera(name: str, position_mm: Array, slit_angle_rad: float, target_mm: Array) -> SensorModel:
    """A camera at a position, aimed at a target, its line turned by an angle."""
    view = (target_mm - position_mm) / np.linalg.norm(target_mm - position_mm)
    side = np.cross([0.0, 1.0, 0.0], view)
    side /= np.linalg.norm(side)
    up = np.cross(view, side)
    along = np.cos(slit_angle_rad) * side + np.sin(slit_angle_rad) * up
    rotation = np.array([along, np.cross(view, along), view])
    x, y, z = Rotation.from_matrix(rotation).as_rotvec().tolist()
    offset = -rotation @ position_mm
    return SensorModel(name, PIXELS, 3000.0, 1023.5, (x, y, z), float(offset[0]), float(offset[2]))


def turned_about_lens(
    model: SensorModel, rotation_rad: Sequence[float], lens_mm: Array
) -> SensorModel:
    """A camera turned where it stands, by a rotation vector in its own frame."""
    rotation = Rotation.from_rotvec(rotation_rad).as_matrix() @ model.rotation
    x, y, z = Rotation.from_matrix(rotation).as_rotvec().tolist()
    offset = -rotation @ lens_mm
    return replace(
        model,
        rotation_vector_rad=(x, y, z),
        offset_x_mm=float(offset[0]),
        offset_z_mm=float(offset[2]),
    )


def rig(sensors: int = 4) -> tuple[SensorModel, ...]:
    """Sensors on a bar of 600 mm that read at different angles, aimed 1.5 m away."""
    positions = np.linspace(-300.0, 300.0, sensors)
    angles = np.pi / 2 + np.arange(sensors) * np.pi / sensors
    target = np.array([0.0, 0.0, 1500.0])
    return tuple(
        camera(f"s{index + 1}", np.array([x, 20.0 * index, 0.0]), float(angle), target)
        for index, (x, angle) in enumerate(zip(positions, angles, strict=True))
    )


def control_points(count: int = 19, seed: int = 11) -> Array:
    """Points spread over 400 mm around the target, seen by every sensor of the rig."""
    rng = np.random.default_rng(seed)
    return np.array([0.0, 0.0, 1500.0]) + rng.uniform(-200.0, 200.0, (count, 3))


def geometry(models: tuple[SensorModel, ...]) -> list[SensorGeometry]:
    """What is known of the sensors before calibration."""
    return [SensorGeometry(model.name, model.pixels) for model in models]


def project(models: tuple[SensorModel, ...], points: Array) -> Array:
    """Exact readings, shape (N, S)."""
    return CameraStack.of(models).project(points)
