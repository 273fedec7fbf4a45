"""Paraxial optics of a centred system: y-nu ray trace, focal length, images, pupils."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.optics.tracing.surfaces import SurfaceStack

Array = NDArray[np.float64]
Meridian = Literal["x", "y"]


@dataclass(frozen=True, eq=False)
class ParaxialSystem:
    """Centred system in one meridian: S surfaces, their curvatures and the media between them.

    Args:
        curvature_per_mm: of each surface, shape (S,) [1/mm].
        conic: conic constants, shape (S,).
        index: refractive index before each surface, and behind the last, shape (S + 1,).
        vertex_mm: their places on the axis, shape (S,) [mm].
        image_mm: place of the sensor's plane [mm].
    """

    curvature_per_mm: Array
    conic: Array
    index: Array
    vertex_mm: Array
    image_mm: float

    @property
    def focal_length_mm(self) -> float:
        """Focal length f' in the space behind [mm]; infinite for a stack without power."""
        _, angle = self.trace(1.0, 0.0)
        return float(-1.0 / angle[-1]) if angle[-1] != 0.0 else np.inf

    def trace(self, height_mm: float, angle: float) -> tuple[Array, Array]:
        """Trace one ray by y-nu from the plane of the first vertex.

        Args:
            height_mm: height at the first vertex [mm].
            angle: slope before the first surface, dy/dz.

        Returns:
            Heights at the surfaces, shape (S,) [mm], and slopes before each surface and behind
            the last, shape (S + 1,).
        """
        heights, angles = np.empty(len(self.vertex_mm)), np.empty(len(self.index))
        angles[0], y = angle, height_mm
        for number, curvature in enumerate(self.curvature_per_mm):
            if number:
                y += angles[number] * (self.vertex_mm[number] - self.vertex_mm[number - 1])
            heights[number] = y
            before, behind = self.index[number], self.index[number + 1]
            angles[number + 1] = (before * angles[number] - y * curvature * (behind - before)) / (
                behind
            )
        return heights, angles

    def reversed(self) -> "ParaxialSystem":
        """Return the same system traversed from behind; its first vertex lies at 0."""
        return ParaxialSystem(
            -self.curvature_per_mm[::-1],
            self.conic[::-1],
            self.index[::-1],
            self.vertex_mm[-1] - self.vertex_mm[::-1],
            self.image_mm,
        )

    def image_of(self, object_mm: float) -> tuple[float, float]:
        """Return position [mm] and lateral magnification of the image of an axial object.

        Raises:
            InvalidParameter: an object in the plane of the first vertex or in the front focus.
        """
        depth = self.vertex_mm[0] - object_mm
        if depth == 0.0:
            raise InvalidParameter(
                f"object_mm is {object_mm}, the first vertex; put the object before it",
                object_mm=object_mm,
            )
        height, angle = self.trace(depth, 1.0)
        if angle[-1] == 0.0:
            raise InvalidParameter(
                f"object_mm is {object_mm}, the front focus, which is imaged at infinity",
                object_mm=object_mm,
            )
        position = self.vertex_mm[-1] - height[-1] / angle[-1]
        return float(position), float(self.index[0] / (self.index[-1] * angle[-1]))

    def entrance_pupil_mm(self, stop: int) -> float:
        """Return the position of the entrance pupil, the stop seen from the front [mm].

        Args:
            stop: number of the surface that is the stop.

        Raises:
            InvalidParameter: no such surface, or a telecentric system (pupil at infinity).
        """
        if not 0 <= stop < len(self.vertex_mm):
            raise InvalidParameter(
                f"stop is {stop}; the stack has the surfaces 0 to {len(self.vertex_mm) - 1}",
                stop=stop,
            )
        # The height at the stop is linear in height and slope at the first vertex.
        by_height = self.trace(1.0, 0.0)[0][stop]
        by_slope = self.trace(0.0, 1.0)[0][stop]
        if by_height == 0.0:
            raise InvalidParameter(
                f"stop is {stop}, in the rear focus of what is before it: the entrance pupil is "
                "at infinity; choose another",
                stop=stop,
            )
        return float(self.vertex_mm[0] + by_slope / by_height)


def paraxial_system(stack: SurfaceStack, meridian: Meridian = "x") -> ParaxialSystem:
    """Return the paraxial system of a centred stack in one meridian.

    Args:
        stack: surfaces on the axis, untilted.
        meridian: "x", along the pixels (a cylinder's power), or "y".

    Raises:
        InvalidParameter: no surface, or one that is off the axis or tilted.
    """
    if not stack.surfaces:
        raise InvalidParameter("surfaces is empty; give at least one", surfaces=())
    for number, surface in enumerate((*stack.surfaces, stack.image)):
        if any(surface.vertex_mm[:2]) or any(surface.rotation_vector_rad):
            raise InvalidParameter(
                f"surface {number} is off the axis or tilted (vertex_mm {surface.vertex_mm}, "
                f"rotation_vector_rad {surface.rotation_vector_rad}); third-order theory is for "
                "centred systems",
                vertex_mm=surface.vertex_mm,
            )
    axis = 0 if meridian == "x" else 1
    return ParaxialSystem(
        np.array([surface.shape.curvatures_per_mm[axis] for surface in stack.surfaces]),
        np.array([float(surface.shape.conic) for surface in stack.surfaces]),
        np.array([stack.index_in_front, *(surface.index_behind for surface in stack.surfaces)]),
        np.array([float(surface.vertex_mm[2]) for surface in stack.surfaces]),
        float(stack.image.vertex_mm[2]),
    )
