"""Stack of surfaces as flat records that both ray tracers read."""

from enum import IntEnum
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.native.records import Record
from compute.optics.tracing.surfaces import Plane, Surface, SurfaceStack, Toroid


class Form(IntEnum):
    """Method by which the intersection with a surface is found."""

    PLANE = 0
    QUADRIC = 1
    """Conic or cylinder: cx x^2 + cy y^2 + e z^2 = 2 z."""
    TOROID = 2


_FORMS: Final[dict[type, Form]] = {Plane: Form.PLANE, Toroid: Form.TOROID}

SURFACE: Final = Record(
    "Surface",
    {
        "form": "int",
        "is_rotated": "int",  # its rotation is not the identity
        "refracts": "int",  # the indices before and behind it differ
        "elliptical": "int",
        "vertex_mm": "double[3]",
        "rotation": "double[3][3]",  # own frame to the system's
        "cx": "double",
        "cy": "double",
        "e": "double",  # (1 + conic constant) x curvature of the profile
        "index_before": "double",
        "index_behind": "double",
        "ratio": "double",  # index before / index behind
        "half_width_mm": "double",
        "half_height_mm": "double",
        "profile_reach_mm": "double",  # of a toroid: where the profile ends in x
        "reach_mm": "double",  # of a toroid: no point is farther from the vertex
        "radius_mm": "double",  # of a toroid: the smaller of its radii
    },
)
SURFACE_RECORD: Final = SURFACE.dtype
"""One surface."""

Records = NDArray[np.void]

BACKWARD_SLACK_MM: Final = 1e-9
"""A crossing this little behind a ray's start counts: surfaces may touch, and numbers round."""

OPEN_REACH: Final = 1e3
"""Radii within which crossings of a saddle with an open profile are searched; it has no end."""


@lru_cache(maxsize=64)
def pack(stack: SurfaceStack) -> Records:
    """Return S surfaces of a stack and, last, its image plane: SURFACE_RECORD, shape (S+1,).

    Read-only, and kept: the same stack is traced thousands of times.
    """
    records = np.zeros(len(stack.surfaces) + 1, SURFACE_RECORD)
    before = stack.index_in_front
    for record, surface in zip(records, stack.surfaces, strict=False):
        _fill(record, surface)
        aperture = surface.aperture
        record["half_width_mm"] = np.inf if aperture is None else aperture.width_mm / 2.0
        record["half_height_mm"] = np.inf if aperture is None else aperture.height_mm / 2.0
        record["elliptical"] = aperture is not None and aperture.outline == "elliptical"
        record["index_before"], record["index_behind"] = before, surface.index_behind
        record["ratio"] = before / surface.index_behind
        record["refracts"] = before != surface.index_behind
        before = surface.index_behind
    image = records[-1]
    _fill(image, stack.image)
    image["half_width_mm"] = image["half_height_mm"] = np.inf
    image["index_before"] = image["index_behind"] = before
    records.setflags(write=False)
    return records


def _fill(record: np.void, surface: Surface) -> None:
    shape = surface.shape
    cx, cy = shape.curvatures_per_mm
    record["form"] = _FORMS.get(type(shape), Form.QUADRIC)
    record["is_rotated"] = any(surface.rotation_vector_rad)
    record["vertex_mm"], record["rotation"] = surface.vertex_mm, surface.rotation
    record["cx"], record["cy"], record["e"] = cx, cy, (1.0 + shape.conic) * cx
    if isinstance(shape, Toroid):
        record["radius_mm"] = min(abs(shape.radius_x_mm), abs(shape.radius_y_mm))
        record["profile_reach_mm"], record["reach_mm"] = _reaches(shape)


def _reaches(shape: Toroid) -> tuple[float, float]:
    """Return where the profile ends in x, and a bound on the distance from the vertex [mm].

    The profile is ``c x^2 = 2 g - e g^2``; rotated about the axis, no point is farther from it
    than the profile is, and only the sheet from the vertex to the axis counts.
    """
    cx, cy = shape.curvatures_per_mm
    e = (1.0 + shape.conic) * cx
    profile = 1.0 / np.sqrt(e * cx) if e * cx > 0.0 else np.inf
    radius = abs(shape.radius_y_mm)
    if cx * cy > 0.0:
        # From the tangent plane (g = 0) to the axis (g = Ry), which the rotation carries around it.
        x = min(profile, np.sqrt((2.0 * radius + abs(e) * radius**2) / abs(cx)))
        return profile, 1.001 * float(np.hypot(x, np.sqrt(2.0) * radius))
    if e * cx > 0.0:
        # Away from the axis, and the profile's ellipse is 1/|e| deep.
        return profile, 1.001 * float(np.hypot(profile, np.sqrt(2.0) * (radius + 1.0 / abs(e))))
    return profile, OPEN_REACH * (abs(shape.radius_x_mm) + radius)
