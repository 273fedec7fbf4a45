"""Refraction in a coded window: the point of the mask that shades a pixel."""

from dataclasses import dataclass

import numpy as np

from compute.errors import InvalidParameter
from compute.optics.coded_aperture.coded_window import CodedWindow
from compute.optics.tracing.surfaces import Array, check_index

_ITERATIONS = 60
_TOLERANCE = 4.0 * np.finfo(np.float64).eps


@dataclass(frozen=True, eq=False)
class WindowPaths:
    """Rays from points to pixels through a window, all arrays of the same shape.

    Args:
        mask_fraction: how far from the pixel towards the point, seen along z, a ray crosses
            the mask: the crossing is at ``pixel + mask_fraction (point - pixel)`` in x and in y.
        density_sr_per_mm2: solid angle at the point per area of pixel [sr/mm^2].
        transmittance: share of unpolarised light that passes both faces of the plate; light
            that is reflected to and fro in the plate is not counted.
        phase_curvature_per_mm: second derivative W of the optical path along x at the
            crossing, the path along y being stationary [1/mm].
    """

    mask_fraction: Array
    density_sr_per_mm2: Array
    transmittance: Array
    phase_curvature_per_mm: Array


def trace_window(
    window: CodedWindow, across_mm: Array, along_mm: Array, z_mm: Array
) -> WindowPaths:
    """Trace the rays from points to pixels through a window exactly, in three dimensions.

    A plane-parallel plate keeps the plane of incidence and the angle in air, t. With the
    distance D in air and the plate's thickness d and index n, a ray ends at the lateral distance
    ``R = D tan t + d tan t'``, ``sin t = n sin t'``: one equation for tan t, concave, solved
    by Newton from below. The angle is the full one, so a skew ray (``along_mm`` not zero) is
    refracted more than its projection. Solid angle: ``sin t dt / (R dR)``. Curvature: with
    the path's second derivatives in the plane of incidence, h, and across it, k, and the
    azimuth f of that plane, ``W = h k / (h sin^2 f + k cos^2 f)``.

    Args:
        window: the window.
        across_mm: x of the point less x of the pixel [mm], any shape that broadcasts.
        along_mm: y of the point less y of the pixel [mm].
        z_mm: z of the point [mm]; larger than the plate's thickness.
    """
    gap, thickness, index = window.gap_mm, window.plate_thickness_mm, window.plate_index
    across, along, depth = np.broadcast_arrays(across_mm, along_mm, z_mm)
    air = depth - thickness + gap
    lateral = np.hypot(across, along)
    slope = ray_tangent_in_air(lateral, air, thickness, index)

    square = 1.0 + slope**2
    cosine = 1.0 / np.sqrt(square)
    # sqrt(n^2 + (n^2 - 1) tan^2 t) = n cos t' / cos t
    ratio = np.sqrt(index**2 + (index**2 - 1.0) * slope**2)
    inside = ratio * cosine / index  # cos t'

    stretch = air * square + thickness * cosine / (index * inside**3)  # dR/dt
    per_sine = air / cosine + thickness / (index * inside)  # R / sin t
    outside = air - gap
    h = cosine**3 / gap + cosine / (outside * square + thickness * cosine / (index * inside**3))
    k = cosine / gap + 1.0 / (outside / cosine + thickness / (index * inside))
    with np.errstate(invalid="ignore"):
        in_plane = np.where(lateral > 0.0, (across / lateral) ** 2, 1.0)  # cos^2 f
    return WindowPaths(
        mask_fraction=gap / (air + thickness / ratio),
        density_sr_per_mm2=1.0 / (per_sine * stretch),
        # Out of the plate as much passes as into it; the polarisations take their own ways.
        transmittance=(transmittances(cosine, 1.0, index) ** 2).mean(axis=-1),
        phase_curvature_per_mm=h * k / (h * (1.0 - in_plane) + k * in_plane),
    )


def ray_tangent_in_air(
    lateral_mm: Array, air_mm: Array, thickness_mm: float, index: float
) -> Array:
    """Return tan t in air of the rays that cross a plate and end at lateral distances.

    Args:
        lateral_mm: distances across the normal of the plate, any shape [mm].
        air_mm: distances in air along the normal, same shape [mm].
        thickness_mm: the plate's thickness [mm].
        index: its refractive index.
    """
    slope = lateral_mm / (air_mm + thickness_mm / index)
    moving = np.ones(np.shape(slope), dtype=np.bool_)
    for _ in range(_ITERATIONS):
        squared = index**2 + (index**2 - 1.0) * slope**2
        excess = lateral_mm - slope * (air_mm + thickness_mm / np.sqrt(squared))
        step = excess / (air_mm + thickness_mm * index**2 / squared**1.5)
        # Each ray stops for itself: a result must not depend on the rays beside it.
        moving &= abs(step) > _TOLERANCE * slope
        if not moving.any():
            break
        slope = np.where(moving, slope + step, slope)
    return np.asarray(slope)


def transmittances(cos_incidence: Array, index_before: float, index_behind: float) -> Array:
    """Return the transmitted shares of the power at a bare surface, for s and p, shape (..., 2).

    Power and not intensity: the factor ``n cos`` of both sides is in it. Total reflection gives 0,
    equal indices 1.

    Args:
        cos_incidence: cosines of the angles of incidence, 0 to 1, shape (...).
        index_before: refractive index on the side of the incident light.
        index_behind: refractive index behind the surface.

    Raises:
        InvalidParameter: a cosine outside 0 .. 1, an index outside 1 .. 10.

    Source: Born & Wolf, Principles of Optics, 1.5.2 (20a), 1.5.3.
    """
    inner = np.asarray(cos_incidence, dtype=np.float64)
    wrong = ~((inner >= 0.0) & (inner <= 1.0))
    if wrong.any():
        raise InvalidParameter(
            f"cos_incidence has {inner[wrong].ravel()[0]}; a cosine of incidence is from 0 to 1",
            cos_incidence=float(inner[wrong].ravel()[0]),
        )
    check_index(index_before=index_before)
    check_index(index_behind=index_behind)
    if index_before == index_behind:
        inner = outer = np.ones_like(inner)
    else:
        square = 1.0 - (index_before / index_behind) ** 2 * (1.0 - inner) * (1.0 + inner)
        outer = np.sqrt(np.maximum(square, 0.0))  # zero where all is reflected
    # The admittances of the media on both sides, for s and p.
    before = np.stack([index_before * inner, index_behind * inner], axis=-1)
    behind = np.stack([index_behind * outer, index_before * outer], axis=-1)
    total = before + behind  # zero only where all is reflected
    amplitude = 2.0 * np.sqrt(before * behind)
    ratio = np.divide(amplitude, total, out=np.zeros_like(total), where=total > 0.0)
    return np.asarray(ratio**2)
