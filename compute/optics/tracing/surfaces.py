"""Surfaces of an optical system: shape, position, aperture, and the medium behind."""

from dataclasses import dataclass
from typing import ClassVar, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from compute.camera.model import Vector3
from compute.errors import InvalidParameter
from compute.parameter_checks import check_finite, require

Array = NDArray[np.float64]

Outline = Literal["rectangular", "elliptical"]


@dataclass(frozen=True)
class Plane:
    """The plane z = 0."""

    curvatures_per_mm: ClassVar = (0.0, 0.0)
    conic: ClassVar = 0.0


@dataclass(frozen=True)
class _ConicProfile:
    radius_mm: float
    conic: float = 0.0

    def __post_init__(self) -> None:
        _check_profile(self.conic, radius_mm=self.radius_mm)


@dataclass(frozen=True)
class Conic(_ConicProfile):
    """Conic of revolution about z; a sphere has the conic constant 0.

    Args:
        radius_mm: radius of curvature at the vertex [mm], positive with the centre at +z.
        conic: conic constant: 0 sphere, -1 paraboloid, below hyperboloid, above 0 oblate.

    Raises:
        InvalidParameter: a radius that is zero or not finite, a conic constant not finite.
    """

    @property
    def curvatures_per_mm(self) -> tuple[float, float]:
        """Curvature along x and along y at the vertex [1/mm]."""
        return (1.0 / self.radius_mm, 1.0 / self.radius_mm)


@dataclass(frozen=True)
class Cylinder(_ConicProfile):
    """Cylinder along y: a conic profile along x, the direction that has the optical power.

    Args and errors are those of ``Conic``.
    """

    @property
    def curvatures_per_mm(self) -> tuple[float, float]:
        """Curvature along x and along y at the vertex [1/mm]."""
        return (1.0 / self.radius_mm, 0.0)


@dataclass(frozen=True)
class Toroid:
    """Toroid: a profile in the x-z plane, rotated about an axis parallel to x at ``radius_y_mm``.

    With g the distance of the profile from the vertex's tangent plane, rotated,
    ``g = Ry - sign(Ry) sqrt(y^2 + (Ry - z)^2)``, the surface is ``c (x^2 + (1 + k) g^2) = 2 g``.

    Args:
        radius_x_mm: radius of the profile at the vertex [mm], positive with the centre at +z.
        radius_y_mm: radius of the rotation [mm], positive with the axis at +z.
        conic: conic constant of the profile, as of ``Conic``.

    Raises:
        InvalidParameter: a radius that is zero or not finite, a conic constant not finite.
    """

    radius_x_mm: float
    radius_y_mm: float
    conic: float = 0.0

    def __post_init__(self) -> None:
        _check_profile(self.conic, radius_x_mm=self.radius_x_mm, radius_y_mm=self.radius_y_mm)

    @property
    def curvatures_per_mm(self) -> tuple[float, float]:
        """Curvature along x and along y at the vertex [1/mm]."""
        return (1.0 / self.radius_x_mm, 1.0 / self.radius_y_mm)


Shape = Plane | Conic | Cylinder | Toroid


def sag(shape: Shape, x_mm: Array, y_mm: Array) -> Array:
    """Return the height z of a surface over its vertex's tangent plane, same shape as x [mm].

    NaN where the surface does not reach that far out.

    Args:
        shape: of the surface.
        x_mm: any shape [mm].
        y_mm: same shape [mm].
    """
    cx, cy = shape.curvatures_per_mm
    square = x_mm**2 + y_mm**2 if isinstance(shape, Conic) else x_mm**2
    with np.errstate(invalid="ignore"):
        profile = cx * square / (1.0 + np.sqrt(1.0 - (1.0 + shape.conic) * cx**2 * square))
        if not isinstance(shape, Toroid):
            return np.asarray(profile)
        # g is the profile's own sag; the rotation then carries it to y. Beyond the axis is not the
        # surface any more.
        rotated = 1.0 - cy * profile
        rotated = np.where(rotated >= 0.0, rotated, np.nan)
        root = np.sqrt(rotated**2 - (cy * y_mm) ** 2)
        # (1 - root) / cy, without the cancellation where cy is small.
        return np.asarray((profile * (2.0 - cy * profile) + cy * y_mm**2) / (1.0 + root))


def check_index(**refractive_index: float) -> None:
    """Raise InvalidParameter unless a refractive index is from 1 to below 10.

    Args:
        refractive_index: one index, by its parameter's name.
    """
    (index,) = refractive_index.values()
    require(1.0 <= index < 10.0, "be from 1 to 10", **refractive_index)


def _check_profile(conic: float, **radii_mm: float) -> None:
    for name, radius in radii_mm.items():
        valid = bool(np.isfinite(radius)) and radius != 0.0
        require(valid, "be finite and not zero (a plane has no radius)", **{name: radius})
    require(np.isfinite(conic), "be finite", conic=conic)


@dataclass(frozen=True)
class Aperture:
    """Aperture that a ray must pass, in the x-y plane of its surface.

    Args:
        width_mm: full size along x, the direction of the pixels [mm]; may be infinite.
        height_mm: full size along y, the lens's axis [mm]; may be infinite.
        outline: "rectangular", or "elliptical" (round where width and height are equal).

    Raises:
        InvalidParameter: a size that is not positive, or an unknown outline.
    """

    width_mm: float
    height_mm: float = np.inf
    outline: Outline = "rectangular"

    def __post_init__(self) -> None:
        require(self.width_mm > 0.0, "be positive", width_mm=self.width_mm)
        require(self.height_mm > 0.0, "be positive", height_mm=self.height_mm)
        outlines = get_args(Outline)
        right = f"be one of {', '.join(outlines)}"
        require(self.outline in outlines, right, outline=self.outline)


@dataclass(frozen=True)
class Surface:
    """One surface of a system, in the system's frame.

    The frame's z axis is the optical axis and points with the light, from the object to the
    sensor; x lies along the pixels (a cylinder's power), y along the lens's axis.

    Args:
        shape: its shape, in a frame of its own with the vertex at the origin.
        vertex_mm: the vertex in the system's frame [mm].
        rotation_vector_rad: rotates the surface's own frame into the system's [rad].
        index_behind: refractive index behind it, 1 for air; that in front is the one behind the
            surface before.
        aperture: its opening; None: unlimited.

    Raises:
        InvalidParameter: an index below 1, a position or rotation that is not finite.
    """

    shape: Shape
    vertex_mm: Vector3 = (0.0, 0.0, 0.0)
    rotation_vector_rad: Vector3 = (0.0, 0.0, 0.0)
    index_behind: float = 1.0
    aperture: Aperture | None = None

    def __post_init__(self) -> None:
        check_index(index_behind=self.index_behind)
        check_finite(self, "vertex_mm", "rotation_vector_rad")

    @property
    def rotation(self) -> Array:
        """The rotation from the surface's own frame to the system's, shape (3, 3)."""
        matrix: Array = Rotation.from_rotvec(self.rotation_vector_rad).as_matrix()
        return matrix


@dataclass(frozen=True)
class SurfaceStack:
    """Surfaces in the order in which the light meets them, and the plane where it ends.

    Args:
        surfaces: none or more.
        image: the plane of the sensor; its aperture is ignored.
        index_in_front: refractive index before the first surface.

    Raises:
        InvalidParameter: the image is not a plane.
    """

    surfaces: tuple[Surface, ...]
    image: Surface
    index_in_front: float = 1.0

    def __post_init__(self) -> None:
        if not isinstance(self.image.shape, Plane):
            raise InvalidParameter(
                f"image is of shape {self.image.shape}; a sensor is a plane", image=self.image.shape
            )
        check_index(index_in_front=self.index_in_front)
