"""Cameras with a two-dimensional sensor, as a pair of linear ones that share all their parameters.

[2.7]-[2.9] are two equations of the kind that a linear sensor has, of one rotation and one centre.
So a rig may mix both kinds: everything downstream sees linear sensors.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.field_distortion import FieldDistortion, Term
from compute.camera.model import PARAMETER_COUNT, SensorModel, Vector3, vector3
from compute.camera.rotation import rotation_matrix, rotation_vector
from compute.errors import InvalidParameter

Array = NDArray[np.float64]

QUARTER_TURN: Final = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""From the camera's frame to that of the sensor that reads y: its row lies along y."""

RADIAL_TERMS: Final[tuple[dict[Term, float], ...]] = (
    {(3, 0): 1.0, (1, 2): 1.0},
    {(5, 0): 1.0, (3, 2): 2.0, (1, 4): 1.0},
    {(7, 0): 1.0, (5, 2): 3.0, (3, 4): 3.0, (1, 6): 1.0},
)
"""u r^2, u r^4, u r^6 of [2.12] as terms in u and v; the same for both readings."""
DECENTRING_TERMS_ALONG: Final[dict[Term, float]] = {(2, 0): 3.0, (0, 2): 1.0}
DECENTRING_TERMS_ACROSS: Final[dict[Term, float]] = {(1, 1): 2.0}
"""r^2 + 2 u^2 and 2 u v of [2.14]."""


@dataclass(frozen=True)
class PlanarCamera:
    """A camera with square or oblong pixels: ``(px, py) = p0 + c (u + du, v + dv)``.

    u = x/z and v = y/z in the camera's frame, x along the columns' numbers, y along the rows'.

    Args:
        name: its name; its readings are those of sensors ``name.x`` and ``name.y``.
        pixels: numbers of columns and rows.
        principal_distance_px: c_x and c_y [px]; equal with square pixels, which is [2.10].
        principal_point_px: x_p and y_p [px].
        rotation_vector_rad: R_camera_world [rad]; one rotation for both readings is [2.11].
        offset_mm: the world's origin in the camera's frame [mm].
        radial: up to three K of [2.12], of tangents of field angles and not of pixels.
        decentring: p1 and p2 of [2.14], likewise; empty for none.

    Raises:
        InvalidParameter: more than three radial or other than two decentring coefficients.
    """

    name: str
    pixels: tuple[int, int]
    principal_distance_px: tuple[float, float]
    principal_point_px: tuple[float, float]
    rotation_vector_rad: Vector3
    offset_mm: Vector3
    radial: tuple[float, ...] = ()
    decentring: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if len(self.radial) > len(RADIAL_TERMS) or len(self.decentring) not in (0, 2):
            raise InvalidParameter(
                f"camera {self.name} has {len(self.radial)} radial and {len(self.decentring)} "
                f"decentring coefficients; it may have up to {len(RADIAL_TERMS)}, and none or 2"
            )

    @property
    def square(self) -> bool:
        """Whether the pixels are square."""
        return self.principal_distance_px[0] == self.principal_distance_px[1]

    def sensors(self) -> tuple[SensorModel, SensorModel]:
        """Return the linear sensors that read x and y."""
        rotation = rotation_matrix(np.array(self.rotation_vector_rad))
        offset = np.array(self.offset_mm)
        models = []
        for axis, rotation_to_sensor in enumerate((np.eye(3), QUARTER_TURN)):
            x, y, z = (rotation_to_sensor @ offset).tolist()
            terms = self._terms(axis)
            lens = None
            if terms:
                lens = FieldDistortion(tuple(terms), tuple(terms.values()), y, derived=True)
            models.append(
                SensorModel(
                    f"{self.name}.{'xy'[axis]}",
                    self.pixels[axis],
                    self.principal_distance_px[axis],
                    self.principal_point_px[axis],
                    vector3(rotation_vector(rotation_to_sensor @ rotation)),
                    x,
                    z,
                    distortion=lens,
                )
            )
        return models[0], models[1]

    def _terms(self, axis: int) -> dict[Term, float]:
        terms: dict[Term, float] = {}
        for coefficient, own in self._coefficients(axis):
            for term, share in own.items():
                terms[term] = terms.get(term, 0.0) + coefficient * share
        return terms

    def _coefficients(self, axis: int) -> list[tuple[float, dict[Term, float]]]:
        """Return the coefficients in their order, each with its terms in one sensor's u and v.

        The sensor that reads y has u' = v and v' = -u: 2 u v is -2 u' v' there.
        """
        found = list(zip(self.radial, RADIAL_TERMS, strict=False))
        if self.decentring:
            sign = 1.0 if axis == 0 else -1.0
            across = {term: sign * share for term, share in DECENTRING_TERMS_ACROSS.items()}
            shares = (
                (DECENTRING_TERMS_ALONG, across) if axis == 0 else (across, DECENTRING_TERMS_ALONG)
            )
            found += zip(self.decentring, shares, strict=True)
        return found

    def sensor_jacobian(self, square: bool) -> Array:
        """Return d (parameters of both sensors) / d (the camera's), shape (P, Q).

        P are those of ``sensors()``, in the order of ``SensorModel.parameter_names``, x then y; Q
        are c (or c_x, c_y), x_p, y_p, a small left rotation, the offset, radial, decentring.
        """
        distances = 1 if square else 2
        lenses = len(self.radial) + len(self.decentring)
        width = distances + 2 + 6 + lenses
        blocks = []
        for axis, rotation_to_sensor in enumerate((np.eye(3), QUARTER_TURN)):
            terms = list(self._terms(axis))
            block = np.zeros((PARAMETER_COUNT + (1 + len(terms) if terms else 0), width))
            block[0, axis if distances == 2 else 0] = 1.0
            block[1, distances + axis] = 1.0
            pose = distances + 2
            block[2:5, pose : pose + 3] = rotation_to_sensor
            block[5, pose + 3 : pose + 6] = rotation_to_sensor[0]
            block[6, pose + 3 : pose + 6] = rotation_to_sensor[2]
            if terms:
                block[7, pose + 3 : pose + 6] = rotation_to_sensor[1]
                for column, (_, own) in enumerate(self._coefficients(axis)):
                    for term, share in own.items():
                        block[8 + terms.index(term), pose + 6 + column] += share
            blocks.append(block)
        return np.concatenate(blocks)

    def retract(self, step: Array, square: bool) -> "PlanarCamera":
        """Return the camera after a step of its parameters, in the order of ``sensor_jacobian``."""
        if square:
            step = np.concatenate([step[:1], step])
        turned = rotation_matrix(step[4:7]) @ rotation_matrix(np.array(self.rotation_vector_rad))
        radial = np.asarray(self.radial) + step[10 : 10 + len(self.radial)]
        decentring = np.asarray(self.decentring) + step[10 + len(self.radial) :]
        cx, cy = (np.asarray(self.principal_distance_px) + step[:2]).tolist()
        x, y = (np.asarray(self.principal_point_px) + step[2:4]).tolist()
        return replace(
            self,
            principal_distance_px=(cx, cy),
            principal_point_px=(x, y),
            rotation_vector_rad=vector3(rotation_vector(turned)),
            offset_mm=vector3(np.asarray(self.offset_mm) + step[7:10]),
            radial=tuple(radial.tolist()),
            decentring=tuple(decentring.tolist()),
        )


def dlt_eleven_parameters(camera: PlanarCamera) -> Array:
    """Return L1..L11 of [2.9] of a camera without distortion, shape (11,).

    Raises:
        InvalidParameter: the world's origin lies in the plane of depth 0, where [2.9] has no form.
    """
    rotation = rotation_matrix(np.array(camera.rotation_vector_rad))
    rows = np.column_stack([rotation, camera.offset_mm])
    if abs(rows[2, 3]) < 1e-12 * max(1.0, float(np.abs(rows).max())):
        raise InvalidParameter(
            f"camera {camera.name}: the world's origin has depth {rows[2, 3]:g} mm, and [2.9] "
            "divides by it; move the origin, for example to the control points"
        )
    (cx, cy), (x, y) = camera.principal_distance_px, camera.principal_point_px
    first, second = cx * rows[0] + x * rows[2], cy * rows[1] + y * rows[2]
    values: Array = np.concatenate([first, second, rows[2, :3]]) / rows[2, 3]
    return values


def dlt_constraints(parameters: Array) -> tuple[float, float]:
    """Return the left sides of [2.10] and [2.11] of L1..L11 (11,), over |(L9, L10, L11)|^2.

    Both are 0 of a camera with square pixels in rows at right angles; the first is
    c_x^2 - c_y^2.
    """
    first, second, third = parameters[:3], parameters[4:7], parameters[8:11]
    norm = float(third @ third)
    along, up = float(first @ third), float(second @ third)
    square = float(first @ first) - float(second @ second) - (along**2 - up**2) / norm
    right = float(first @ second) - along * up / norm
    return square / norm, right / norm


def normal_case(
    first_px: Array, second_px: Array, base_mm: float, principal_distance_px: float
) -> Array:
    """Return points of the normal case of photogrammetry, [2.6], shape (N, 3) [mm].

    Two cameras of one principal distance look along parallel axes at right angles to their base.

    Args:
        first_px: x and y in the first camera from its principal point, shape (N, 2) [px].
        second_px: in the second, shape (N, 2) [px].
        base_mm: B, from the first to the second along x [mm].
        principal_distance_px: c [px].

    Returns:
        Points; NaN where x_1 is not larger than x_2 (no such point lies before the cameras).
    """
    parallax = first_px[:, 0] - second_px[:, 0]
    parallax = np.where(parallax * np.sign(base_mm) > 0.0, parallax, np.nan)
    depth = base_mm * principal_distance_px / parallax
    height = depth * (first_px[:, 1] + second_px[:, 1]) / (2.0 * principal_distance_px)
    return np.column_stack([base_mm * first_px[:, 0] / parallax, height, depth])
