"""Exact conversions between the metric camera, its 2x4 matrix and the thesis's parameters."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import SensorGeometry, SensorModel, Vector3, vector3
from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.transform import rotation_vector

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CollinearityParameters:
    """The eleven coefficients of the thesis's collinearity form [5.18]-[5.19].

    ``-(p - p0)/c = l.(X - X0) / m.(X - X0)`` with ``l = (L1, L2, L3)``, ``m = (L4, L5, L6)``.
    Four of the eleven are free gauge: the common scale of l and m, the scale of l against c,
    l plus k times m against p0, and the shift of X0 along the lens's axis (l x m).

    Args:
        c: principal distance, in the unit of the readings.
        p0: principal point, in the unit of the readings.
        centre_mm: X0, Y0, Z0, a point on the lens's axis [mm].
        along: L1, L2, L3.
        axis: L4, L5, L6.
    """

    c: float
    p0: float
    centre_mm: Vector3
    along: Vector3
    axis: Vector3

    def in_pixels(self, pitch_mm: float) -> "CollinearityParameters":
        """Convert c and p0 from mm, counted from the sensor's edge, to pixels of this pitch."""
        return replace(self, c=self.c / pitch_mm, p0=self.p0 / pitch_mm - 0.5)


def model_from_matrix(
    matrix: Array, sensor: SensorGeometry, seen_mm: Array | None = None, cubic_per_px2: float = 0.0
) -> SensorModel:
    """Return the metric camera of a 2x4 matrix, whatever its scale and sign.

    [5.3] gives the principal point; what is left of the first row is along the sensor.

    Args:
        matrix: shape (2, 4).
        sensor: name and pixels for the model.
        seen_mm: a world point in front of the lens, shape (3,): the readings alone do not tell
            front from back. Without it the second row is taken as the viewing axis.
        cubic_per_px2: D of [5.2] for the model.

    Raises:
        InvalidParameter: the rows are dependent: no camera has this matrix.
    """
    first, second = np.asarray(matrix, dtype=np.float64)
    norm = float(np.linalg.norm(second[:3]))
    if not np.isfinite(matrix).all() or norm == 0.0:
        raise InvalidParameter(
            f"sensor {sensor.name}: the second row of the camera matrix is {second.tolist()}; "
            "its first three values must be finite and not all zero",
            sensor=sensor.name,
        )
    if seen_mm is not None and float(second[:3] @ seen_mm + second[3]) < 0.0:
        first, second = -first, -second
    first, second = first / norm, second / norm
    principal_point = float(first[:3] @ second[:3])
    along = first - principal_point * second
    principal_distance = float(np.linalg.norm(along[:3]))
    if principal_distance <= 1e-12 * max(1.0, abs(principal_point)):
        raise InvalidParameter(
            f"sensor {sensor.name}: the two rows of the camera matrix are parallel; "
            "a camera needs a direction along the sensor that differs from its view",
            sensor=sensor.name,
        )
    along = along / principal_distance
    rotation = np.array([along[:3], np.cross(second[:3], along[:3]), second[:3]])
    x, y, z = rotation_vector(rotation).tolist()
    return SensorModel(
        sensor.name,
        sensor.pixels,
        principal_distance,
        principal_point,
        (x, y, z),
        float(along[3]),
        float(second[3]),
        cubic_per_px2,
    )


def dlt_parameters_of(model: SensorModel) -> Array:
    """Return L1..L7 of thesis [5.1], shape (7,).

    Raises:
        InvalidParameter: the world's origin lies in the plane through the lens parallel to the
            sensor, where the denominator's constant, which [5.1] sets to 1, is zero.
    """
    matrix = CameraStack.of([model]).matrices[0]
    scale = float(matrix[1, 3])
    if abs(scale) < 1e-12 * max(1.0, float(np.abs(matrix).max())):
        raise InvalidParameter(
            f"sensor {model.name}: the world's origin has depth {scale:g} mm from the lens, "
            "and the DLT form divides by it; move the origin, for example to the control points",
            sensor=model.name,
        )
    return np.concatenate([matrix[0] / scale, matrix[1, :3] / scale])


def collinearity_parameters_of(model: SensorModel) -> CollinearityParameters:
    """Return the eleven coefficients in the gauge of rotation rows.

    X0 is the point of the lens's axis nearest the world's origin; the thesis's frame looks
    along its negative z axis ([5.17]), so L4..L6 is minus the viewing axis and l the direction
    along the sensor.
    """
    rotation = model.rotation
    centre = -model.offset_x_mm * rotation[0] - model.offset_z_mm * rotation[2]
    return CollinearityParameters(
        model.principal_distance_px,
        model.principal_point_px,
        vector3(centre),
        vector3(rotation[0]),
        vector3(-rotation[2]),
    )


def model_from_collinearity(
    parameters: CollinearityParameters, sensor: SensorGeometry, seen_mm: Array | None = None
) -> SensorModel:
    """Return the metric camera of the eleven coefficients [5.18]-[5.19], in any gauge.

    Without ``seen_mm`` the scene lies on the negative side of L4..L6, as in [5.17].

    Args:
        parameters: the eleven coefficients.
        sensor: the sensor.
        seen_mm: a point in front of the lens, shape (3,) [mm]; None: as the coefficients have it.
    """
    along, axis = np.array(parameters.along), np.array(parameters.axis)
    first = parameters.p0 * axis - parameters.c * along
    rows = -np.array([first, axis])
    matrix = np.column_stack([rows, -rows @ np.array(parameters.centre_mm)])
    return model_from_matrix(matrix, sensor, seen_mm)
