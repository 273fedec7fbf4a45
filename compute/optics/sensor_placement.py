"""Line sensors placed in the world: with ideal lenses, or with real optics."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from compute.camera.model import SensorModel, Vector3, vector3
from compute.errors import InvalidParameter
from compute.optics.pixel_row import PixelRow
from compute.optics.tracing.assembly import Assembly

Array = NDArray[np.float64]

__all__ = [
    "OpticalSensor", "PlacedSensor", "SensorModel", "Vector3", "place_optics", "place_sensor",
    "sensor_rotation", "to_optics_frame",
]  # fmt: skip


@dataclass(frozen=True)
class PlacedSensor:
    """Camera model with the lens's position along the slit and the pixel pitch.

    Args:
        model: where a point of light is read.
        lens_position_mm: the lens's centre in the world frame [mm].
        pitch_um: pixel pitch [um].
    """

    model: SensorModel
    lens_position_mm: Vector3
    pitch_um: float


def place_sensor(
    name: str,
    *,
    lens_position_mm: Vector3,
    aim_mm: Vector3,
    measured_direction: Vector3,
    principal_distance_mm: float,
    pixels: int,
    pitch_um: float,
) -> PlacedSensor:
    """Place a sensor by its position and aim, its principal point in the middle of its pixels.

    The frame's z axis points from the lens to ``aim_mm``; its x axis, along the pixels, is
    ``measured_direction`` made perpendicular to z; the slit is y = z x x (Figure 5.2 of the
    thesis shows four such sensors).

    Args:
        name: the sensor's name in its device.
        lens_position_mm: the lens's centre in the world frame [mm].
        aim_mm: a point on the sensor's axis, imaged on the middle of the pixels [mm].
        measured_direction: world direction along which readings grow; any length.
        principal_distance_mm: the lens's distance from the pixels [mm].
        pixels: number of pixels.
        pitch_um: pixel pitch [um].

    Raises:
        InvalidParameter: the aim lies on the lens, or the measured direction on the axis.
    """
    rotation = sensor_rotation(name, lens_position_mm, aim_mm, measured_direction)
    position = np.asarray(lens_position_mm, dtype=np.float64)
    offset = -rotation @ position
    model = SensorModel(
        name=name,
        pixels=pixels,
        principal_distance_px=principal_distance_mm / (pitch_um * 1e-3),
        principal_point_px=(pixels - 1) / 2,
        rotation_vector_rad=vector3(Rotation.from_matrix(rotation).as_rotvec()),
        offset_x_mm=float(offset[0]),
        offset_z_mm=float(offset[2]),
    )
    return PlacedSensor(model, lens_position_mm, pitch_um)


def sensor_rotation(
    name: str, position_mm: Vector3, aim_mm: Vector3, measured_direction: Vector3
) -> NDArray[np.float64]:
    """Return the rotation from the world to a sensor's frame, shape (3, 3); see ``place_sensor``.

    Args:
        name: of the sensor, for messages.
        position_mm: centre of its lens in the world [mm].
        aim_mm: a point on its axis [mm].
        measured_direction: world direction along which readings grow; any length.

    Raises:
        InvalidParameter: the aim lies on the lens, or the measured direction on the axis.
    """
    position = np.asarray(position_mm, dtype=np.float64)
    axis = np.asarray(aim_mm, dtype=np.float64) - position
    distance = float(np.linalg.norm(axis))
    if not distance > 0.0:
        raise InvalidParameter(
            f"aim_mm of sensor {name} is {aim_mm}, the sensor's own position; aim it at a point in "
            "front of it",
            aim_mm=aim_mm,
        )
    axis /= distance
    along = np.asarray(measured_direction, dtype=np.float64)
    length = float(np.linalg.norm(along))
    across = along - (along @ axis) * axis
    if not np.linalg.norm(across) > 1e-6 * length:
        raise InvalidParameter(
            f"measured_direction of sensor {name} is {measured_direction}; it must not be zero, "
            f"nor the sensor's viewing direction {tuple(axis.tolist())}",
            measured_direction=measured_direction,
        )
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(axis, across), axis])


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
