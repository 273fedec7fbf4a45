"""Row of pixels behind its optics, placed in the world."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from compute.camera.model import Vector3, vector3
from compute.optics.pixel_row import PixelRow
from compute.optics.sensor_placement import sensor_rotation
from compute.optics.tracing.assembly import Assembly

Array = NDArray[np.float64]

# From the sensor's frame, whose z points to the object, to the optics', whose z goes with the
# light: half a turn about x.
_HALF_ROTATION = np.array([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class OpticalSensor:
    """Line sensor with real optics.

    The sensor's frame has x along growing readings, y along the lens's axis and z towards the
    object, as a camera model's has.

    Args:
        name: the sensor's name in its device.
        position_mm: origin of the optics' frame in the world [mm].
        rotation_vector_rad: rotation from the world to the sensor's frame [rad].
        assembly: the optics.
        row: the pixels.
    """

    name: str
    position_mm: Vector3
    rotation_vector_rad: Vector3
    assembly: Assembly
    row: PixelRow

    @cached_property
    def rotation(self) -> Array:
        """The rotation from the world to the sensor's frame, shape (3, 3)."""
        matrix: Array = Rotation.from_rotvec(self.rotation_vector_rad).as_matrix()
        return matrix

    def to_sensor_frame(self, points_mm: Array) -> Array:
        """Return points (N, 3) of the world in the sensor's frame [mm]."""
        local_mm: Array = (points_mm - np.asarray(self.position_mm)) @ self.rotation.T
        return local_mm


def to_optics_frame(points_mm: Array) -> Array:
    """Return points (N, 3) of a sensor's frame in the frame of its optics [mm]."""
    rotated: Array = points_mm * _HALF_ROTATION
    return rotated


def place_optics(
    name: str,
    *,
    position_mm: Vector3,
    aim_mm: Vector3,
    measured_direction: Vector3,
    assembly: Assembly,
    row: PixelRow,
) -> OpticalSensor:
    """Place optics and their row of pixels by position and aim; see ``place_sensor``.

    Args:
        name: of the sensor.
        position_mm: origin of the optics' frame in the world [mm].
        aim_mm: a point on the optical axis, in front of the sensor [mm].
        measured_direction: world direction along which readings grow; any length.
        assembly: the optics.
        row: the pixels.

    Raises:
        InvalidParameter: the aim lies on the position, or the measured direction on the axis.
    """
    rotation = sensor_rotation(name, position_mm, aim_mm, measured_direction)
    rotation_vector_rad = vector3(Rotation.from_matrix(rotation).as_rotvec())
    return OpticalSensor(name, position_mm, rotation_vector_rad, assembly, row)
