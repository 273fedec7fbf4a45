"""SensorModel: the calibrated 1D camera in its metric form, seven parameters and distortion."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from compute.camera.field_distortion import FieldDistortion, Term
from compute.transform import rotation_matrix

Vector3 = tuple[float, float, float]


def vector3(row: NDArray[np.float64]) -> Vector3:
    """Return an array of three values as plain floats."""
    x, y, z = row.tolist()
    return x, y, z


PARAMETERS: Final = (
    "principal_distance_px",
    "principal_point_px",
    "rotation_x_rad",
    "rotation_y_rad",
    "rotation_z_rad",
    "offset_x_mm",
    "offset_z_mm",
)
"""Order of the seven parameters in every Jacobian and covariance; the rotation is a small left
rotation in the sensor's frame (``R <- exp([w]x) R``)."""

PARAMETER_COUNT: Final = len(PARAMETERS)
"""Parameters of a camera without distortion. One with distortion has more: after the seven come
``offset_y_mm`` and its coefficients, see ``parameter_names``."""


@dataclass(frozen=True)
class SensorGeometry:
    """Name and pixels of a sensor, known before calibration.

    Args:
        name: the sensor's name.
        pixels: number of pixels.
        pitch_um: pixel pitch [um]; None: not known, and then nor is the row's distance behind the
            lens (``FieldDistortion.row_behind_mm``).
    """

    name: str
    pixels: int
    pitch_um: float | None = None


@dataclass(frozen=True)
class SensorModel:
    """One calibrated linear sensor: ``p = p0 + c x/z`` with ``(x, z)`` in the sensor's frame.

    The frame has x along the sensor, y along the slit (the lens's axis) and z towards the scene;
    ``x = r1 . X + offset_x_mm`` and ``z = r3 . X + offset_z_mm`` for a world point X [mm], with
    r1, r3 the first and third row of the rotation. A shift along the slit changes no reading of
    such a camera, so it is no parameter. With distortion ``p = p0 + c (u + d(u, v))``, see
    ``compute.camera.field_distortion``, and the shift along the slit is one.

    Args:
        name: the sensor's name in its device.
        pixels: number of pixels; readings lie in ``[-0.5, pixels - 0.5]``.
        principal_distance_px: c, the lens's distance from the sensor [px], positive.
        principal_point_px: p0, the reading on the axis [px].
        rotation_vector_rad: axis times angle of R_sensor_world, world to sensor [rad].
        offset_x_mm: x of the world's origin in the sensor's frame [mm].
        offset_z_mm: z of the world's origin in the sensor's frame [mm].
        cubic_per_px2: D of thesis [5.2]; a reading p is first corrected to
            ``p + D (p - p0)^3`` ([5.12]). Zero in the metric calibration.
        distortion: the lens's distortion by both field angles; None: none.
    """

    name: str
    pixels: int
    principal_distance_px: float
    principal_point_px: float
    rotation_vector_rad: Vector3
    offset_x_mm: float
    offset_z_mm: float
    cubic_per_px2: float = 0.0
    distortion: FieldDistortion | None = None

    @property
    def parameter_count(self) -> int:
        """Number of parameters: 7, or 8 and one for each term of the distortion."""
        return PARAMETER_COUNT + (0 if self.distortion is None else 1 + len(self.terms))

    @property
    def terms(self) -> tuple[Term, ...]:
        """The terms of the distortion; none without."""
        return () if self.distortion is None else self.distortion.terms

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters in the order of Jacobians and covariances."""
        if self.distortion is None:
            return PARAMETERS
        terms = (f"u{i}v{j}" for i, j in self.terms)
        return (*PARAMETERS, "offset_y_mm", *terms)

    @cached_property
    def rotation(self) -> NDArray[np.float64]:
        """R_sensor_world, shape (3, 3)."""
        return rotation_matrix(np.array(self.rotation_vector_rad))

    def retract(self, step: NDArray[np.float64]) -> "SensorModel":
        """Return the model after a step of its parameters, in the order of ``parameter_names``."""
        turned = Rotation.from_rotvec(step[2:5]) * Rotation.from_rotvec(self.rotation_vector_rad)
        distortion = self.distortion
        if distortion is not None:
            coefficients = np.asarray(distortion.coefficients) + step[PARAMETER_COUNT + 1 :]
            distortion = replace(
                distortion,
                offset_y_mm=distortion.offset_y_mm + float(step[PARAMETER_COUNT]),
                coefficients=tuple(coefficients.tolist()),
            )
        return replace(
            self,
            principal_distance_px=self.principal_distance_px + float(step[0]),
            principal_point_px=self.principal_point_px + float(step[1]),
            rotation_vector_rad=vector3(turned.as_rotvec()),
            offset_x_mm=self.offset_x_mm + float(step[5]),
            offset_z_mm=self.offset_z_mm + float(step[6]),
            distortion=distortion,
        )
