"""Ideal 1D sensors: central projection on a row, and the point that fits readings best.

Written from the geometry alone, without any code of the project.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


@dataclass(frozen=True)
class IdealSensor:
    """A sensor at a position that looks along ``view`` and reads along ``row`` (unit vectors)."""

    position: Array
    row: Array
    view: Array
    distance_px: float
    middle_px: float

    def read(self, points: Array) -> Array:
        """Return the readings of points (N, 3)."""
        sight = points - self.position
        return self.middle_px + self.distance_px * (sight @ self.row) / (sight @ self.view)

    def moved(self, shift: Array, rotation: Array, stretch: float = 0.0) -> "IdealSensor":
        """Return it shifted, turned about its position by a rotation vector, and stretched."""
        turn = Rotation.from_rotvec(rotation).as_matrix()
        return IdealSensor(
            self.position + shift,
            turn @ self.row,
            turn @ self.view,
            self.distance_px * (1.0 + stretch),
            self.middle_px,
        )


def aimed_sensor(position: Array, target: Array, angle: float) -> IdealSensor:
    """A sensor of 3000 px principal distance, its row turned by an angle from the horizontal."""
    view = (target - position) / np.linalg.norm(target - position)
    side = np.cross([0.0, 1.0, 0.0], view)
    side /= np.linalg.norm(side)
    row = np.cos(angle) * side + np.sin(angle) * np.cross(view, side)
    return IdealSensor(position, row, view, 3000.0, 1023.5)


def locate(sensors: list[IdealSensor], readings: Array, sigma: Array, start: Array) -> Array:
    """Return the points (N, 3) that fit readings (N, S) best, weighted by 1 / sigma^2 (S,)."""
    found = []
    for row, first in zip(readings, start, strict=True):

        def residuals(point: Array, row: Array = row) -> Array:
            predicted = np.array([float(one.read(point[None])[0]) for one in sensors])
            return (predicted - row) / sigma

        found.append(least_squares(residuals, first, xtol=1e-14, ftol=1e-14).x)
    return np.array(found)
