"""Solid angles through which the pixels collect the light of points."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PixelSolidAngles:
    """Solid angles of N points on S sensors, as windows of W pixels.

    Mean electrons of a pixel are its solid angle times the photoelectrons that the point sends
    out per steradian: ``photons per steradian x filter x quantum efficiency``.

    Args:
        first_px: number of the first pixel of each window, int64, shape (N, S); a window may
            reach over the ends of the line.
        solid_angle_sr: effective solid angle through which each pixel of the window collects
            light of the point, losses at the surfaces included, shape (N, S, W) [sr].
    """

    first_px: NDArray[np.int64]
    solid_angle_sr: Array


class SolidAngleOptics(Protocol):
    """Interface of the optics: traced lenses, tables of them, coded windows."""

    def solid_angles(self, points_mm: Array) -> PixelSolidAngles:
        """Return the solid angles of points (N, 3) in the world frame [mm]."""
        ...


def scan_electrons(
    solid_angles: PixelSolidAngles, electrons_per_sr: Array, markers: int, pixels: int
) -> Array:
    """Return the mean electrons of the pixels by all markers of each frame.

    Args:
        solid_angles: of F x M points (frame by frame) on S sensors.
        electrons_per_sr: photoelectrons that each point sends out towards each sensor per
            steradian, shape (F x M, S).
        markers: M, the points of one frame; at least 1.
        pixels: pixels of a row.

    Returns:
        Mean electrons, shape (F, S, pixels).
    """
    points, sensors, width = solid_angles.solid_angle_sr.shape
    frames = points // markers
    light = solid_angles.solid_angle_sr * electrons_per_sr[:, :, None]
    line = (np.arange(points) // markers)[:, None] * sensors + np.arange(sensors)
    pixel = solid_angles.first_px[:, :, None] + np.arange(width)
    inside = (pixel >= 0) & (pixel < pixels)
    place = (line[:, :, None] * pixels + pixel)[inside]
    image = np.bincount(place, light[inside], minlength=frames * sensors * pixels)
    return image.reshape(frames, sensors, pixels).astype(np.float64, copy=False)
