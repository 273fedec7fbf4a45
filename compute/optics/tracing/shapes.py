"""Shapes of optical surfaces: plane, conic of revolution, cylinder, toroid."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Plane:
    """The plane z = 0."""

    @property
    def curvatures_per_mm(self) -> tuple[float, float]:
        """Curvature along x and along y at the vertex [1/mm]."""
        return (0.0, 0.0)

    @property
    def conic(self) -> float:
        """Conic constant; irrelevant to a plane."""
        return 0.0


@dataclass(frozen=True)
class Conic:
    """Conic of revolution about z; a sphere has the conic constant 0.

    Args:
        radius_mm: radius of curvature at the vertex [mm], positive with the centre at +z.
        conic: conic constant: 0 sphere, -1 paraboloid, below hyperboloid, above 0 oblate.

    Raises:
        InvalidParameter: a radius that is zero or not finite, a conic constant not finite.
    """

    radius_mm: float
    conic: float = 0.0

    def __post_init__(self) -> None:
        _check_radius("radius_mm", self.radius_mm)
        _check_conic(self.conic)

    @property
    def curvatures_per_mm(self) -> tuple[float, float]:
        """Curvature along x and along y at the vertex [1/mm]."""
        return (1.0 / self.radius_mm, 1.0 / self.radius_mm)


@dataclass(frozen=True)
class Cylinder:
    """Cylinder along y: curved along x, the direction that has the optical power.

    Args:
        radius_mm: radius of curvature at the vertex [mm], positive with the centre at +z.
        conic: conic constant of the profile, as of ``Conic``.

    Raises:
        InvalidParameter: a radius that is zero or not finite, a conic constant not finite.
    """

    radius_mm: float
    conic: float = 0.0

    def __post_init__(self) -> None:
        _check_radius("radius_mm", self.radius_mm)
        _check_conic(self.conic)

    @property
    def curvatures_per_mm(self) -> tuple[float, float]:
        """Curvature along x and along y at the vertex [1/mm]."""
        return (1.0 / self.radius_mm, 0.0)


@dataclass(frozen=True)
class Toroid:
    """Toroid: a profile in the x-z plane, rotated about an axis parallel to x at ``radius_y_mm``.

    With g the distance of the profile from the vertex's tangent plane, turned,
    ``g = Ry - sign(Ry) sqrt(y^2 + (Ry - z)^2)``, the surface is ``c (x^2 + (1 + k) g^2) = 2 g``.

    Args:
        radius_x_mm: radius of the profile at the vertex [mm], positive with the centre at +z.
        radius_y_mm: radius of the turn [mm], positive with the axis at +z.
        conic: conic constant of the profile, as of ``Conic``.

    Raises:
        InvalidParameter: a radius that is zero or not finite, a conic constant not finite.
    """

    radius_x_mm: float
    radius_y_mm: float
    conic: float = 0.0

    def __post_init__(self) -> None:
        _check_radius("radius_x_mm", self.radius_x_mm)
        _check_radius("radius_y_mm", self.radius_y_mm)
        _check_conic(self.conic)

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
        # g is the profile's own sag; the turn then carries it to y. Beyond the axis is not the
        # surface any more.
        turned = 1.0 - cy * profile
        turned = np.where(turned >= 0.0, turned, np.nan)
        root = np.sqrt(turned**2 - (cy * y_mm) ** 2)
        # (1 - root) / cy, without the cancellation where cy is small.
        return np.asarray((profile * (2.0 - cy * profile) + cy * y_mm**2) / (1.0 + root))


def _check_radius(name: str, value: float) -> None:
    if not np.isfinite(value) or value == 0.0:
        raise InvalidParameter(
            f"{name} is {value}; it must be finite and not zero (a plane has no radius)",
            **{name: value},
        )


def _check_conic(value: float) -> None:
    if not np.isfinite(value):
        raise InvalidParameter(f"conic is {value}; it must be finite", conic=value)
