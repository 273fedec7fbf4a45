"""Several 1D cameras as arrays: projection of points and its Jacobians, batched."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import PARAMETER_COUNT, SensorModel

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CameraStack:
    """S cameras, parameter by parameter; made once for a calibration, then used for batches.

    Args:
        principal_distance_px: c, shape (S,) [px].
        principal_point_px: p0, shape (S,) [px].
        rotation: R_sensor_world, shape (S, 3, 3).
        offset_mm: x and z of the world's origin in the sensors' frames, shape (S, 2) [mm].
        cubic_per_px2: D of thesis [5.2], shape (S,) [1/px^2].
    """

    principal_distance_px: Array
    principal_point_px: Array
    rotation: Array
    offset_mm: Array
    cubic_per_px2: Array

    @classmethod
    def of(cls, models: Sequence[SensorModel]) -> "CameraStack":
        """Gather the models' parameters in order."""
        return cls(
            np.array([model.principal_distance_px for model in models], dtype=np.float64),
            np.array([model.principal_point_px for model in models], dtype=np.float64),
            np.array([model.rotation for model in models]).reshape(-1, 3, 3),
            np.array([(model.offset_x_mm, model.offset_z_mm) for model in models]).reshape(-1, 2),
            np.array([model.cubic_per_px2 for model in models], dtype=np.float64),
        )

    def __len__(self) -> int:
        """Return the number of cameras."""
        return len(self.principal_distance_px)

    @cached_property
    def matrices(self) -> Array:
        """The 2x4 matrices (m1; m2) with ``p = m1.X~ / m2.X~``, shape (S, 2, 4).

        In this gauge m2 is the viewing axis, so that m2.X~ is the depth in mm.
        """
        along = np.concatenate([self.rotation[:, 0], self.offset_mm[:, :1]], axis=1)
        depth = np.concatenate([self.rotation[:, 2], self.offset_mm[:, 1:]], axis=1)
        first = (
            self.principal_distance_px[:, None] * along + self.principal_point_px[:, None] * depth
        )
        return np.stack([first, depth], axis=1)

    def corrected(self, readings_px: Array) -> Array:
        """Return readings (..., S) with the cubic distortion term added, thesis [5.12]."""
        return readings_px + self.cubic_per_px2 * (readings_px - self.principal_point_px) ** 3

    def correction_slope(self, readings_px: Array) -> Array:
        """Return d corrected / d reading, shape (..., S): scales a reading's deviation."""
        return 1.0 + 3.0 * self.cubic_per_px2 * (readings_px - self.principal_point_px) ** 2

    def project(self, points_mm: Array) -> Array:
        """Project points (N, 3) [mm] to corrected readings (N, S) [px].

        NaN where the point does not lie in front of the lens. A reading may lie outside the
        sensor: the line of pixels has an end, the projection has none.
        """
        u, _ = self._field(points_mm)
        return self.principal_point_px + self.principal_distance_px * u

    def _field(self, points_mm: Array) -> tuple[Array, Array]:
        """Return u = x/z and the depth z [mm], both (N, S); NaN at and behind the lens."""
        sensor: Array = np.einsum("sij,nj->nsi", self.rotation[:, ::2], points_mm)
        sensor += self.offset_mm
        depth = np.where(sensor[..., 1] > 0.0, sensor[..., 1], np.nan)
        return sensor[..., 0] / depth, depth

    def linearised(self, points_mm: Array) -> tuple[Array, Array]:
        """Project points (N, 3) and return readings (N, S) and d reading / d point (N, S, 3)."""
        u, depth = self._field(points_mm)
        gain = self.principal_distance_px / depth
        slope = gain[..., None] * (self.rotation[:, 0] - u[..., None] * self.rotation[:, 2])
        return self.principal_point_px + self.principal_distance_px * u, slope

    def parameter_jacobian(self, points_mm: Array) -> Array:
        """Return d reading / d parameters, shape (N, S, 7), in the order of PARAMETERS."""
        rotated = np.einsum("sij,nj->nsi", self.rotation, points_mm)
        u, depth = self._field(points_mm)
        return reading_slopes(rotated, u, self.principal_distance_px / depth)


def reading_slopes(rotated_mm: Array, u: Array, gain: Array) -> Array:
    """Return d reading / d parameters, shape (..., 7), in the order of PARAMETERS.

    Args:
        rotated_mm: R X, the points turned but not shifted, shape (..., 3) [mm].
        u: tangent of the field angle along the sensor, x/z, shape (...).
        gain: c / depth, shape (...) [px/mm].
    """
    a, b, d = rotated_mm[..., 0], rotated_mm[..., 1], rotated_mm[..., 2]
    jacobian = np.empty((*u.shape, PARAMETER_COUNT))
    jacobian[..., 0] = u
    jacobian[..., 1] = 1.0
    # A left rotation w moves R X by w x R X; only its x and z components are read.
    jacobian[..., 2] = -gain * u * b
    jacobian[..., 3] = gain * (d + u * a)
    jacobian[..., 4] = -gain * b
    jacobian[..., 5] = gain
    jacobian[..., 6] = -gain * u
    return jacobian
