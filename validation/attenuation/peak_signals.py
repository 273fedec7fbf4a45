"""Peak signals of a bright disc behind a cylindrical and a spherical lens, by traced rays."""

from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.optics.pixel_row import PixelRow
from compute.optics.stripe_optics.stripe_profile import Blur, StripeProfiles
from compute.optics.stripe_optics.traced_stripes import RaySampling, TracedStripes
from compute.optics.tracing.assembly import Assembly, Lens
from compute.optics.tracing.reference_tracer import RayStatus, trace_rays
from compute.optics.tracing.surfaces import Aperture, Conic, Plane
from validation.aberrations.paraxial import paraxial_system
from validation.aberrations.thesis_lens import (
    HEIGHT_MM,
    INDEX,
    LENS,
    RADIUS_MM,
    THICKNESS_MM,
    WIDTH_MM,
)

Array = NDArray[np.float64]

DISTANCE_MM: Final = 4000.0
PITCH_UM: Final = 10.0
"""A half-inch sensor, 6.4 x 4.8 mm, as the frame grabber's 640 x 480 pixels."""
ROWS_AVERAGED: Final = 300
SEARCHED_MM: Final = np.arange(-4.0, 0.1, 0.25)
"""Places of the sensor from the paraxial image among which the best focus is looked for."""

ROUND_LENS: Final = Lens(
    (Plane(), Conic(-RADIUS_MM)),
    (THICKNESS_MM,),
    (INDEX,),
    Aperture(WIDTH_MM, WIDTH_MM, "elliptical"),
)
"""A sphere of the cylinder's profile and width."""

_ROW: Final = PixelRow(640, PITCH_UM, PITCH_UM)
_RINGS: Final = 200
_ANGLES: Final = 72
_IN_PIXEL: Final = (np.arange(5) - 2.0) / 5.0  # of a pixel: places that its signal is averaged over


@dataclass(frozen=True)
class Setting:
    """What the text does not say.

    Args:
        target_mm: diameter of a target, an evenly bright disk [mm].
        sphere_focus_mm: place of the sensor behind the sphere, from the paraxial image [mm].
        cylinder_focus_mm: the same behind the cylinder [mm].
        tilt_rad: turn of the line against the pixels' columns, over which rows are averaged [rad].
    """

    target_mm: float
    sphere_focus_mm: float
    cylinder_focus_mm: float
    tilt_rad: float = 0.0


def paraxial_image_mm() -> float:
    """Return where either lens images a point at DISTANCE_MM [mm]."""
    stack = Assembly((LENS,), 100.0).stack()
    return paraxial_system(stack).image_of(-DISTANCE_MM)[0]


def focal_length_mm() -> float:
    """Return the focal length of either lens [mm]."""
    return paraxial_system(Assembly((LENS,), 100.0).stack()).focal_length_mm


def cylinder_peak_sr(target_mm: float, focus_mm: float, tilt_rad: float = 0.0) -> float:
    """Return the brightest pixel's signal behind the cylinder, averaged over rows, by intensity.

    Args:
        target_mm: diameter of the target [mm].
        focus_mm: place of the sensor, from the paraxial image [mm].
        tilt_rad: turn of the line against the columns [rad].

    Returns:
        Effective solid angle through which the pixel collects the target's light [sr].
    """
    line = _cylinder_line(target_mm, focus_mm)
    pixels = line.pixels_sr[0]
    shifts = np.tan(tilt_rad) * (np.arange(ROWS_AVERAGED) - 0.5 * (ROWS_AVERAGED - 1))
    pixel = np.arange(len(pixels))
    rows = [np.interp(pixel, pixel + shift, pixels) for shift in shifts]
    return float(np.mean(rows, axis=0).max())


def sphere_peak_sr(target_mm: float, focus_mm: float) -> float:
    """Return the brightest pixel's signal behind the sphere, by intensity; see the cylinder's.

    A ray of the target's middle that misses the pixel by less than the radius of the target's
    image is made up for by one from elsewhere on the target: to first order a point's blur is
    the same all over the small image.
    """
    position, light, magnification = _sphere_rays(focus_mm)
    radius = 0.5 * target_mm * magnification
    pitch = PITCH_UM * 1e-3
    share = np.mean(
        [
            light[np.hypot(position[:, 0] - x * pitch, position[:, 1] - y * pitch) < radius].sum()
            for x in _IN_PIXEL
            for y in _IN_PIXEL
        ]
    )
    return float(share * pitch**2 / (np.pi * radius**2))


def perfect_sphere_peak_sr(target_mm: float, focal_ratio: float) -> float:
    """Return the same behind a lens without aberration or loss, of a given focal ratio f/D.

    The radiance theorem: irradiance ``pi L sin^2``, L being intensity by the target's area; f is
    that of the other lenses, for the target's image of the same size.
    """
    pitch = PITCH_UM * 1e-3
    f = focal_length_mm()
    distance = f * DISTANCE_MM / (DISTANCE_MM - f)
    sine_squared = 1.0 / (1.0 + (2.0 * focal_ratio * distance / f) ** 2)
    radius = 0.5 * target_mm
    return float(np.pi * sine_squared * pitch**2 / (np.pi * radius**2))


def ratio(setting: Setting) -> float:
    """Return the attenuation [3.28] for the spherical lens of the same profile and width."""
    return sphere_peak_sr(setting.target_mm, setting.sphere_focus_mm) / cylinder_peak_sr(
        setting.target_mm, setting.cylinder_focus_mm, setting.tilt_rad
    )


def best_focus_mm(target_mm: float) -> tuple[float, float]:
    """Return the places of the sensor where sphere and cylinder give the brightest pixel [mm]."""
    sphere = [sphere_peak_sr(target_mm, float(focus)) for focus in SEARCHED_MM]
    cylinder = [cylinder_peak_sr(target_mm, float(focus)) for focus in SEARCHED_MM]
    return float(SEARCHED_MM[np.argmax(sphere)]), float(SEARCHED_MM[np.argmax(cylinder)])


def thin_ratio(target_mm: float, focal_ratio: float) -> float:
    """Return the ratio by a formula, of thin lenses in focus: ``(pi / 4) (A / f)^2 f d / (W D)``.

    A pixel sees the target through the whole sphere, pi A^2 / 4, wherever in the image it is.
    Behind the cylinder it sees it through a strip of the width W and as high, on the lens, as the
    target looks from there, about D f / d.
    """
    f = focal_length_mm()
    return float(0.25 * np.pi / focal_ratio**2 * f * DISTANCE_MM / (WIDTH_MM * target_mm))


def background_ratio() -> float:
    """Return by how much even surroundings are brighter behind the cylinder than the sphere.

    Projected solid angles of the two openings, of the rectangle and the disk, seen from the
    sensor, in the plane of the lens's back.
    """
    distance = paraxial_image_mm() - THICKNESS_MM
    nodes, weights = np.polynomial.legendre.leggauss(40)
    x, y = np.meshgrid(nodes * WIDTH_MM / 2.0, nodes * HEIGHT_MM / 2.0, indexing="ij")
    area = np.outer(weights * WIDTH_MM / 2.0, weights * HEIGHT_MM / 2.0)
    rectangle = float((area * distance**2 / (x**2 + y**2 + distance**2) ** 2).sum())
    radius = WIDTH_MM / 2.0
    return rectangle / float(np.pi * radius**2 / (radius**2 + distance**2))


@cache
def _cylinder_line(target_mm: float, focus_mm: float) -> StripeProfiles:
    assembly = Assembly((LENS,), paraxial_image_mm() + focus_mm)
    lines = TracedStripes(assembly, _ROW, Blur(None, target_mm), RaySampling(65))
    return lines.shapes(np.array([[0.0, 0.0, DISTANCE_MM]]))


@cache
def _sphere_rays(focus_mm: float) -> tuple[Array, Array, float]:
    """Return places on the sensor (R, 2) [mm], light (R,) [sr], and the image's magnification."""
    assembly = Assembly((ROUND_LENS,), paraxial_image_mm() + focus_mm)
    ring = WIDTH_MM / 2.0 * np.sqrt((np.arange(_RINGS) + 0.5) / _RINGS)
    angle = 2.0 * np.pi * np.arange(_ANGLES) / _ANGLES
    r, theta = (g.ravel() for g in np.meshgrid(ring, angle, indexing="ij"))
    pupil = np.stack([r * np.cos(theta), r * np.sin(theta), np.zeros_like(r)], axis=1)
    source = np.broadcast_to([0.0, 0.0, -DISTANCE_MM], pupil.shape)
    rays = trace_rays(assembly.stack(), source, pupil - source)
    arrived = rays.status == RayStatus.ARRIVED
    area = np.pi * WIDTH_MM**2 / 4.0 / len(r)
    solid_angle = area * DISTANCE_MM / (r**2 + DISTANCE_MM**2) ** 1.5
    light = np.where(arrived, solid_angle * rays.transmittance.mean(axis=1), 0.0)
    position = np.where(arrived[:, None], rays.position_mm[:, :2], 0.0)
    # The image's middle moves with the object as the ray through the lens's middle does.
    beside = np.array([[1.0, 0.0, -DISTANCE_MM]])
    chief = trace_rays(assembly.stack(), beside, -beside)
    return position, light, float(abs(chief.position_mm[0, 0]))
