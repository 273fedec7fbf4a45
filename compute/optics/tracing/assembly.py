"""Assembly of lenses and stops before a line sensor."""

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from compute.camera.model import Vector3
from compute.errors import InvalidParameter
from compute.optics.tracing.surfaces import (
    Aperture,
    Array,
    Plane,
    Shape,
    Surface,
    SurfaceStack,
    sag,
)

AIR: Final = 1.0


@dataclass(frozen=True)
class Alignment:
    """Misalignment of an element.

    Args:
        decentre_mm: shift along x (pixels) and y (lens axis) [mm].
        tilt_rad: rotation vector about its front vertex [rad], after the shift.
    """

    decentre_mm: tuple[float, float] = (0.0, 0.0)
    tilt_rad: Vector3 = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Lens:
    """Lens of one piece, or several cemented together; a plate, if both faces are plane.

    Args:
        shapes: its N + 1 faces in the order of the light.
        thicknesses_mm: its N thicknesses on the axis [mm].
        indices: refractive indices of its N glasses.
        aperture: its outline; light outside of it meets the lens's frame and is lost.
        z_mm: position of the front vertex on the optical axis [mm].
        alignment: its misalignment.

    Raises:
        InvalidParameter: numbers of faces, thicknesses and glasses that do not fit; a thickness
            or index out of range; a face that does not reach the edge of the lens; faces that
            meet inside the lens; a lens thicker than the bodies that its faces bound.
    """

    shapes: tuple[Shape, ...]
    thicknesses_mm: tuple[float, ...]
    indices: tuple[float, ...]
    aperture: Aperture
    z_mm: float = 0.0
    alignment: Alignment = field(default_factory=Alignment)

    def __post_init__(self) -> None:
        pieces = len(self.thicknesses_mm)
        if pieces < 1 or len(self.shapes) != pieces + 1 or len(self.indices) != pieces:
            raise InvalidParameter(
                f"a lens of {pieces} thicknesses has {len(self.shapes)} faces and "
                f"{len(self.indices)} indices; it must have {pieces + 1} and {pieces}, and at "
                "least one thickness",
                thicknesses_mm=self.thicknesses_mm,
            )
        for index in self.indices:
            if not 1.0 <= index < 10.0:
                raise InvalidParameter(
                    f"indices has {index}; a glass has 1 to 10", indices=self.indices
                )
        for name in ("width_mm", "height_mm"):
            if not np.isfinite(getattr(self.aperture, name)):
                raise InvalidParameter(
                    f"{name} of a lens is infinite; give the size of the glass",
                    **{name: getattr(self.aperture, name)},
                )
        for piece in range(pieces):
            self._check_piece(piece)

    def holds(self, points_mm: Array) -> NDArray[np.bool_]:
        """Return which points (N, 3) of the system's frame [mm] lie in its glass, shape (N,)."""
        x, y = self.alignment.decentre_mm
        tilt = Rotation.from_rotvec(self.alignment.tilt_rad)
        local = tilt.apply(points_mm - np.array([x, y, self.z_mm]), inverse=True)
        wide, high = 2.0 * local[:, 0] / self.aperture.width_mm, 2.0 * local[:, 1]
        high = high / self.aperture.height_mm
        if self.aperture.outline == "rectangular":
            across = np.maximum(np.abs(wide), np.abs(high)) <= 1.0
        else:
            across = wide**2 + high**2 <= 1.0
        front = sag(self.shapes[0], local[:, 0], local[:, 1])
        back = sum(self.thicknesses_mm) + sag(self.shapes[-1], local[:, 0], local[:, 1])
        return np.asarray(across & (local[:, 2] >= front) & (local[:, 2] <= back))

    def _check_piece(self, piece: int) -> None:
        front, back = self.shapes[piece], self.shapes[piece + 1]
        thickness = self.thicknesses_mm[piece]
        if not 0.0 < thickness < np.inf:
            raise InvalidParameter(
                f"thicknesses_mm has {thickness}; it must be positive",
                thicknesses_mm=self.thicknesses_mm,
            )
        x, y = _outline(self.aperture)
        for face in (front, back):
            if np.isnan(sag(face, x, y)).any():
                raise InvalidParameter(
                    f"a face {face} does not reach the edge of a lens {self.aperture.width_mm} mm "
                    f"wide and {self.aperture.height_mm} mm high; make the lens smaller or the "
                    "radius longer",
                    shapes=self.shapes,
                )
        gap = thickness + sag(back, x, y) - sag(front, x, y)
        if gap.min() < 0.0:
            raise InvalidParameter(
                f"thicknesses_mm has {thickness}, and the faces meet inside the lens, "
                f"{-gap.min():.3g} mm too early at its edge; it must be at least "
                f"{thickness - gap.min():.6g}",
                thicknesses_mm=self.thicknesses_mm,
            )
        limit = _thickest(front, back)
        if thickness > limit:
            raise InvalidParameter(
                f"thicknesses_mm has {thickness}; the curvature of its faces allows at most "
                f"{limit:.6g} mm, the whole ball or cylinder",
                thicknesses_mm=self.thicknesses_mm,
            )


@dataclass(frozen=True)
class Stop:
    """Aperture stop in a thin screen.

    Args:
        aperture: the opening.
        z_mm: its position on the optical axis [mm].
        alignment: its misalignment.
    """

    aperture: Aperture
    z_mm: float = 0.0
    alignment: Alignment = field(default_factory=Alignment)


Element = Lens | Stop


def _outline(aperture: Aperture) -> tuple[np.ndarray, np.ndarray]:
    """Return points along the edge of an opening, x and y, and its centre."""
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    x, y = np.cos(angle), np.sin(angle)
    if aperture.outline == "rectangular":
        x, y = x / np.maximum(abs(x), abs(y)), y / np.maximum(abs(x), abs(y))
    x, y = np.append(x, 0.0), np.append(y, 0.0)
    return x * aperture.width_mm / 2.0, y * aperture.height_mm / 2.0


def _thickest(front: Shape, back: Shape) -> float:
    """Return the thickness of the body that two faces bound, infinite where they bound none."""
    # Convex seen from outside: the front's centre behind it, the back's before it.
    curvatures = [
        *(c for c in front.curvatures_per_mm if c > 0.0),
        *(-c for c in back.curvatures_per_mm if c < 0.0),
    ]
    return 2.0 / max(curvatures) if curvatures else np.inf


@dataclass(frozen=True)
class Assembly:
    """Lenses and stops in the order of the light, and a line sensor behind them.

    The frame is that of ``Surface``: z along the light, x along the pixels, y along the axis of
    the cylindrical lens.

    Args:
        elements: at least one; none may begin before the one before it ends.
        sensor_z_mm: position of the sensor on the optical axis [mm], behind the last element.
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
                source = tuple(round(float(value), 6) for value in points_mm[inside][0])
                raise InvalidParameter(
                    f"points_mm has a source at {source} mm of the optics' frame, inside the glass "
                    f"of element {number + 1}; it must be in front of the optics, which begin at "
                    f"z = {self.front_z_mm} mm",
                    points_mm=source,
                )

    def stack(self) -> SurfaceStack:
        """Return the surfaces in the frame of the assembly."""
        surfaces: list[Surface] = []
        for element in self.elements:
            shapes: tuple[Shape, ...] = (Plane(),)
            indices_behind: tuple[float, ...] = (AIR,)
            depths = np.zeros(1)
            if isinstance(element, Lens):
                shapes, indices_behind = element.shapes, (*element.indices, AIR)
                depths = np.cumsum([0.0, *element.thicknesses_mm])
            surfaces += [
                Surface(
                    shape,
                    *_pose(element.alignment, element.z_mm, float(depth)),
                    index_behind=index,
                    aperture=element.aperture,
                )
                for shape, depth, index in zip(shapes, depths, indices_behind, strict=True)
            ]
        image = Surface(Plane(), *_pose(self.sensor_alignment, self.sensor_z_mm, 0.0))
        return SurfaceStack(tuple(surfaces), image)


def _length(element: Element) -> float:
    return sum(element.thicknesses_mm) if isinstance(element, Lens) else 0.0


def _pose(alignment: Alignment, z_mm: float, depth_mm: float) -> tuple[Vector3, Vector3]:
    """Return the vertex and the rotation of a face that lies ``depth_mm`` behind the first."""
    inward = Rotation.from_rotvec(alignment.tilt_rad).apply([0.0, 0.0, depth_mm])
    x, y = alignment.decentre_mm
    vertex = (float(x + inward[0]), float(y + inward[1]), float(z_mm + inward[2]))
    return vertex, alignment.tilt_rad
