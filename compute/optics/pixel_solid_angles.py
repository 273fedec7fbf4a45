"""Light of points and stripes on rows of pixels: solid angles, images in mean electrons."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

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
    light = light.reshape(-1, width)
    scan = (np.arange(points) // markers)[:, None] * sensors + np.arange(sensors)
    first_px = solid_angles.first_px.ravel()
    image = _add_windows(scan.ravel(), first_px, light, frames * sensors, pixels)
    return image.reshape(frames, sensors, pixels)


_REACH_SIGMA = 6.0  # beyond it lie 2e-9 of a Gaussian


def stripe_images(position_px: Array, sigma_px: Array, electrons: Array, pixels: int) -> Array:
    """Integrate Gaussian stripes over the pixels and add them up, scan by scan.

    Pixel i covers [i - 0.5, i + 0.5]. A stripe outside the row leaves there what of its tail
    falls on it; the tails end at 6 sigma at the earliest, which drops 2e-9 of the light.

    Args:
        position_px: centres of M stripes on each of L scans, shape (L, M) [px]; NaN: no stripe.
        sigma_px: their standard deviations, shape (L, M) [px], positive.
        electrons: their mean electrons in total, shape (L, M).
        pixels: pixels of a scan.

    Returns:
        Mean electrons, shape (L, pixels).
    """
    # One window width for all stripes keeps the work in one array.
    reach = np.ceil(_REACH_SIGMA * float(sigma_px.max(initial=0.0)) + 0.5)
    lit = (position_px > -0.5 - reach) & (position_px < pixels - 0.5 + reach) & (electrons > 0.0)
    position, sigma = position_px[lit][:, None], sigma_px[lit][:, None]
    first = np.rint(position) - reach
    edges = first - 0.5 + np.arange(2 * int(reach) + 2)
    share = np.diff(ndtr((edges - position) / sigma), axis=1)
    light = share * electrons[lit][:, None]
    first_px = first[:, 0].astype(np.int64)
    return _add_windows(np.nonzero(lit)[0], first_px, light, len(position_px), pixels)


def _add_windows(
    scan: NDArray[np.int64], first_px: NDArray[np.int64], light: Array, scans: int, pixels: int
) -> Array:
    """Add windows of light (N, W), each on one scan from a pixel on, shape (scans, pixels)."""
    pixel = first_px[:, None] + np.arange(light.shape[1])
    inside = (pixel >= 0) & (pixel < pixels)
    index = (scan[:, None] * pixels + pixel)[inside]
    image = np.bincount(index, light[inside], minlength=scans * pixels)
    return image.reshape(scans, pixels).astype(np.float64, copy=False)
