"""Line cameras on a ring: readings by four-vectors, apart from ``compute``, and their models."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from compute.camera.model import SensorModel

Array = NDArray[np.float64]

RADIUS_MM = 700.0
DISTANCE_MM = 1500.0
FOCAL_PX = 2500.0
CENTRE_PX = 1000.0
_STEP_MM = 1e-3


def ring(sensors: int) -> tuple[Array, tuple[SensorModel, ...]]:
    """Return cameras that look at the origin from a ring.

    The directions in which they read are turned against one another, so that no two of a point's
    planes are parallel.

    Args:
        sensors: number of cameras S.

    Returns:
        Matrices P, shape (S, 2, 4), of readings ``(P1 . X) / (P2 . X)`` [px]; the same as models.
    """
    matrices, models = [], []
    for index in range(sensors):
        angle = 2.0 * np.pi * index / sensors
        eye = np.array([RADIUS_MM * np.cos(angle), RADIUS_MM * np.sin(angle), DISTANCE_MM])
        ahead = -eye / np.linalg.norm(eye)
        across = np.cross(ahead, [0.0, 0.0, 1.0])
        across /= np.linalg.norm(across)
        turn = np.pi * (0.1 + 0.618 * index)
        along = np.cos(turn) * across + np.sin(turn) * np.cross(across, ahead)
        first = FOCAL_PX * along + CENTRE_PX * ahead
        matrices.append(np.array([np.append(first, -first @ eye), np.append(ahead, -ahead @ eye)]))
        x, y, z = (
            Rotation.from_matrix(np.array([along, np.cross(ahead, along), ahead]))
            .as_rotvec()
            .tolist()
        )
        models.append(
            SensorModel(
                f"s{index + 1}",
                2 * int(CENTRE_PX),
                FOCAL_PX,
                CENTRE_PX,
                (x, y, z),
                float(-along @ eye),
                float(-ahead @ eye),
            )
        )
    return np.array(matrices), tuple(models)


def project(matrices: Array, points_mm: Array) -> Array:
    """Return exact readings of points (..., 3), shape (..., S) [px].

    Args:
        matrices: of S cameras, shape (S, 2, 4).
        points_mm: shape (..., 3).
    """
    values = points_mm @ matrices[:, :, :3].reshape(-1, 3).T + matrices[:, :, 3].ravel()
    first, second = values[..., 0::2], values[..., 1::2]
    readings: Array = first / second
    return readings


def jacobian(matrices: Array, points_mm: Array) -> Array:
    """Return d reading / d point by central differences, shape (..., S, 3) [px/mm].

    Args:
        matrices: of S cameras, shape (S, 2, 4).
        points_mm: shape (..., 3).
    """
    columns = [
        project(matrices, points_mm + step) - project(matrices, points_mm - step)
        for step in _STEP_MM * np.eye(3)
    ]
    return np.stack(columns, axis=-1) / (2.0 * _STEP_MM)
