"""Surface of an optical system: shape, position, aperture, and the medium behind it."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from compute.camera.model import Vector3
from compute.errors import InvalidParameter
from compute.optics.tracing.shapes import Array, Plane, Shape

Outline = Literal["rectangular", "elliptical"]
OUTLINES: Final[tuple[Outline, ...]] = ("rectangular", "elliptical")


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
        for name in ("width_mm", "height_mm"):
            value = getattr(self, name)
            if not value > 0.0:
                raise InvalidParameter(f"{name} is {value}; it must be positive", **{name: value})
        if self.outline not in OUTLINES:
            raise InvalidParameter(
                f"outline is {self.outline!r}; it must be one of {', '.join(OUTLINES)}",
                outline=self.outline,
            )


@dataclass(frozen=True)
class Surface:
    """One surface of a system, in the system's frame.

    The frame's z axis is the optical axis and points with the light, from the object to the
    sensor; x lies along the pixels (a cylinder's power), y along the lens's axis.

    Args:
        shape: its shape, in a frame of its own with the vertex at the origin.
        vertex_mm: the vertex in the system's frame [mm].
        rotation_vector_rad: turns the surface's own frame into the system's [rad].
        index_behind: refractive index behind it, 1 for air; that in front is the one behind the
            surface before.
        aperture: its opening; None: unlimited.

    Raises:
        InvalidParameter: an index below 1, a place or turn that is not finite.
    """

    shape: Shape
    vertex_mm: Vector3 = (0.0, 0.0, 0.0)
    rotation_vector_rad: Vector3 = (0.0, 0.0, 0.0)
    index_behind: float = 1.0
    aperture: Aperture | None = None

    def __post_init__(self) -> None:
        if not 1.0 <= self.index_behind < 10.0:
            raise InvalidParameter(
                f"index_behind is {self.index_behind}; it must be from 1 to 10",
                index_behind=self.index_behind,
            )
        for name in ("vertex_mm", "rotation_vector_rad"):
            value = getattr(self, name)
            if not np.isfinite(value).all():
                raise InvalidParameter(f"{name} is {value}; it must be finite", **{name: value})

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
        if not 1.0 <= self.index_in_front < 10.0:
            raise InvalidParameter(
                f"index_in_front is {self.index_in_front}; it must be from 1 to 10",
                index_in_front=self.index_in_front,
            )
