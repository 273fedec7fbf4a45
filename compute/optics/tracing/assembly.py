"""Assembly of lenses and stops before a line sensor."""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from compute.camera.model import Vector3
from compute.errors import InvalidParameter
from compute.optics.tracing.elements import AIR, Alignment, Element, Lens
from compute.optics.tracing.shapes import Array, Plane
from compute.optics.tracing.surfaces import Surface, SurfaceStack


@dataclass(frozen=True)
class Assembly:
    """Lenses and stops in the order of the light, and a line sensor behind them.

    The frame is that of ``Surface``: z along the light, x along the pixels, y along the axis of
    the cylindrical lens.

    Args:
        elements: at least one; none may begin before the one before it ends.
        sensor_z_mm: place of the sensor on the optical axis [mm], behind the last element.
        sensor_alignment: shift and tilt of the sensor [mm, rad].

    Raises:
        InvalidParameter: no element, elements out of order or inside one another, a sensor that
            is not behind the last element.
    """

    elements: tuple[Element, ...]
    sensor_z_mm: float
    sensor_alignment: Alignment = field(default_factory=Alignment)

    def __post_init__(self) -> None:
        if not self.elements:
            raise InvalidParameter("elements is empty; give at least one lens or stop")
        end = -np.inf
        for number, element in enumerate(self.elements):
            if not np.isfinite(element.z_mm) or element.z_mm < end:
                raise InvalidParameter(
                    f"z_mm of element {number + 1} is {element.z_mm}; the element before it ends "
                    f"at {end} mm",
                    z_mm=element.z_mm,
                )
            end = element.z_mm + _length(element)
        if not end <= self.sensor_z_mm < np.inf:
            raise InvalidParameter(
                f"sensor_z_mm is {self.sensor_z_mm}; the sensor must be behind the last element, "
                f"which ends at {end} mm",
                sensor_z_mm=self.sensor_z_mm,
            )

    @property
    def front_z_mm(self) -> float:
        """Position of the front of the first element on the axis [mm]."""
        return self.elements[0].z_mm

    def check_source(self, points_mm: Array) -> None:
        """Refuse points of light (N, 3) in the assembly's frame [mm] that lie inside a lens.

        Raises:
            InvalidParameter: the first such point, and the lens.
        """
        for number, element in enumerate(self.elements):
            if isinstance(element, Lens) and (inside := element.holds(points_mm)).any():
                place = tuple(round(float(value), 6) for value in points_mm[inside][0])
                raise InvalidParameter(
                    f"points_mm has a source at {place} mm of the optics' frame, inside the glass "
                    f"of element {number + 1}; it must be in front of the optics, which begin at "
                    f"z = {self.front_z_mm} mm",
                    points_mm=place,
                )

    def stack(self) -> SurfaceStack:
        """Return the surfaces in the frame of the assembly."""
        surfaces: list[Surface] = []
        for element in self.elements:
            if isinstance(element, Lens):
                surfaces += _faces(element)
            else:
                surfaces.append(
                    Surface(
                        Plane(),
                        *_pose(element.alignment, element.z_mm, 0.0),
                        index_behind=AIR,
                        aperture=element.aperture,
                    )
                )
        image = Surface(Plane(), *_pose(self.sensor_alignment, self.sensor_z_mm, 0.0))
        return SurfaceStack(tuple(surfaces), image)


def _length(element: Element) -> float:
    return sum(element.thicknesses_mm) if isinstance(element, Lens) else 0.0


def _faces(lens: Lens) -> list[Surface]:
    depths = np.concatenate([[0.0], np.cumsum(lens.thicknesses_mm)])
    behind = (*lens.indices, AIR)
    return [
        Surface(
            shape,
            *_pose(lens.alignment, lens.z_mm, float(depth)),
            index_behind=index,
            aperture=lens.aperture,
        )
        for shape, depth, index in zip(lens.shapes, depths, behind, strict=True)
    ]


def _pose(alignment: Alignment, z_mm: float, depth_mm: float) -> tuple[Vector3, Vector3]:
    """Return the vertex and the rotation of a face that lies ``depth_mm`` behind the first."""
    inward = Rotation.from_rotvec(alignment.tilt_rad).apply([0.0, 0.0, depth_mm])
    x, y = alignment.decentre_mm
    vertex = (float(x + inward[0]), float(y + inward[1]), float(z_mm + inward[2]))
    return vertex, alignment.tilt_rad
