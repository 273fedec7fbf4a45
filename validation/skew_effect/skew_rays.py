"""Skew rays through cylinders, reduced to a plane with a larger effective index.

At a surface whose normal lies in the x-z plane, Snell's law in vectors, ``n' s' - n s = g N``,
leaves the y component of ``n s`` as it is. A stack of planes and cylinders along y has only such
surfaces, so that ``k = n s_y`` is the same all the way. What is left of ``n s`` in the x-z plane
has the length ``sqrt(n^2 - k^2)``, and Snell's law holds between these: the ray's projection is a
ray in the plane, through media of the indices ``sqrt(n^2 - k^2)``. Relative to the air in front,

    N = sqrt(n^2 - k^2) / sqrt(1 - k^2) >= n.

In field angles u = x/z, v = y/z of the ray in air, k^2 = v^2 / (1 + u^2 + v^2), and

    N^2 = n^2 + (n^2 - 1) v^2 / (1 + u^2).

A point seen at v meets a stronger lens: focused shorter, and distorted otherwise.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.optics.tracing.surfaces import Cylinder, Plane, SurfaceStack

Array = NDArray[np.float64]


def effective_index(index: float, u: Array, v: Array) -> Array:
    """Return the effective index for a ray of field angles u, v projected to the x-z plane.

    Args:
        index: refractive index n of the glass, in air.
        u: x/z of the ray in air.
        v: y/z of the ray in air, of u's shape.
    """
    squared: Array = index**2 + (index**2 - 1.0) * v**2 / (1.0 + u**2)
    return np.sqrt(squared)


def in_plane_stack(stack: SurfaceStack, direction_y: float) -> SurfaceStack:
    """Return the stack whose rays in the x-z plane are the projected skew rays.

    A ray of it from the same x and z, with the same dx/dz, takes the same way in x and z.
    Openings are dropped, since y is not known there.

    Args:
        stack: planes and cylinders along y; turned about y only.
        direction_y: y component of the skew ray's unit vector in front of the stack.

    Raises:
        InvalidParameter: another shape, a tilt that takes the normals out of the x-z plane, a
            direction not between -1 and 1.
    """
    if not abs(direction_y) < 1.0:
        raise InvalidParameter(
            f"direction_y is {direction_y}; it must be between -1 and 1", direction_y=direction_y
        )
    for number, surface in enumerate(stack.surfaces):
        turn = surface.rotation_vector_rad
        if not isinstance(surface.shape, Plane | Cylinder) or turn[0] != 0.0 or turn[2] != 0.0:
            raise InvalidParameter(
                f"surface {number} is {surface.shape} with rotation_vector_rad {turn}; it must be "
                "a plane or a cylinder along y, turned about y only",
                shape=surface.shape,
            )
    squared = (stack.index_in_front * direction_y) ** 2
    in_front = np.sqrt(stack.index_in_front**2 - squared)

    def in_plane(index: float) -> float:
        if index < stack.index_in_front:
            raise InvalidParameter(
                f"index_behind is {index}, below that in front, {stack.index_in_front}; give a "
                "stack in air",
                index_behind=index,
            )
        return float(np.sqrt(index**2 - squared) / in_front)

    surfaces = tuple(
        replace(surface, index_behind=in_plane(surface.index_behind), aperture=None)
        for surface in stack.surfaces
    )
    return replace(stack, surfaces=surfaces, index_in_front=1.0)
