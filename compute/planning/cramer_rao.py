"""Derivatives of stripe images by position, pixel noise, and the sigma of a centre of gravity."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.optics.detector import Detector
from compute.optics.pixel_solid_angles import PixelSolidAngles, SolidAngleOptics
from compute.optics.stripe_optics.stripe_profile import CELLS, StripeProfiles
from compute.parameter_checks import check_not_negative, check_positive
from compute.signal.centroid_reference import find_peaks_reference
from compute.signal.centroid_settings import GROUP_PIXELS, SAMPLE_GROUPS, CentroidSettings
from compute.signal.sensor_noise import SensorNoise

Array = NDArray[np.float64]

SHIFT_PX = 0.05
"""Displacement of stripes, both ways, for the derivative of each pixel's light. The relative error
of the central difference is about (SHIFT_PX / s)^2 / 6 for a stripe of standard deviation s: 0.2 %
for 0.5 px."""

_DIRECTION_ANGLES = np.pi * np.arange(24) / 24.0


@dataclass(frozen=True)
class PixelNoise:
    """Noise of a pixel in addition to the signal's shot noise.

    Args:
        read_noise_electrons: standard deviation of the amplifier's noise.
        electrons_per_count: gain of the conversion; rounding to counts has the variance
            gain^2 / 12.
        background_electrons: mean electrons of ambient light and dark current.

    Raises:
        InvalidParameter: a value is negative, or all are zero.
    """

    read_noise_electrons: float
    electrons_per_count: float
    background_electrons: float = 0.0

    @classmethod
    def of(cls, detector: Detector) -> "PixelNoise":
        """Return the noise of a detector's nominal pixel; its dark signal is background."""
        return cls(
            detector.read_noise_electrons,
            detector.electrons_per_count,
            detector.ambient_electrons + detector.dark_electrons,
        )

    def __post_init__(self) -> None:
        check_not_negative(self, *vars(self))
        if self.variance_electrons2 == 0.0:
            raise InvalidParameter(
                "read_noise_electrons, electrons_per_count and background_electrons are all 0; "
                "a pixel without light needs some noise"
            )

    @property
    def variance_electrons2(self) -> float:
        """Variance of a pixel without signal [electrons^2]."""
        return (
            self.background_electrons
            + self.read_noise_electrons**2
            + self.electrons_per_count**2 / 12.0
        )


@dataclass(frozen=True, eq=False)
class Stripes:
    """Stripes of N points on S sensors with their derivatives by position.

    Args:
        first_px: index of the windows' first pixels, int64, shape (N, S).
        mean_sr: light of the pixels [sr], shape (N, S, W); zero beyond the sensor's ends.
        slope_sr_per_px: its derivative by the stripe's position, shape (N, S, W) [sr/px].
    """

    first_px: NDArray[np.int64]
    mean_sr: Array
    slope_sr_per_px: Array


def displaced_stripes(
    optics: SolidAngleOptics,
    cameras: CameraStack,
    points_mm: Array,
    pixels: int,
    here: PixelSolidAngles | None = None,
) -> Stripes:
    """Return stripes with derivatives by displacing each point and forming them anew.

    The derivative holds for stripes of any shape, however narrow compared with a pixel. All points
    move in one direction, in which every sensor is sensitive.

    Args:
        optics: forms the lines.
        cameras: S cameras, accurate enough for the derivatives.
        points_mm: shape (N, 3) [mm].
        pixels: pixels of a line.
        here: the points' footprints, where they are known already.

    Raises:
        InvalidParameter: no sensor sees the centre of the points.
    """
    direction, step = _displacement(cameras, points_mm)
    shift = step * direction
    both = optics.solid_angles(np.concatenate([points_mm + shift, points_mm - shift]))
    half = len(points_mm)
    lines = [
        optics.solid_angles(points_mm) if here is None else here,
        PixelSolidAngles(both.first_px[:half], both.solid_angle_sr[:half]),
        PixelSolidAngles(both.first_px[half:], both.solid_angle_sr[half:]),
    ]
    first = np.min([line.first_px for line in lines], axis=0)
    last = np.max([line.first_px + line.solid_angle_sr.shape[2] for line in lines], axis=0)
    width = int((last - first).max(initial=1))
    mean, ahead, behind = (_in_window(line, first, width, pixels) for line in lines)
    moved = 2.0 * step * (cameras.linearise(points_mm)[1] @ direction)
    moved = np.where(np.isfinite(moved) & (moved != 0.0), moved, np.inf)
    return Stripes(first, mean, (ahead - behind) / moved[..., None])


def shifted_stripes(shapes: Sequence[StripeProfiles], pixels: int) -> Stripes:
    """Return stripes with derivatives by shifting profiles known on a subpixel grid.

    The shift is one cell of the grid, 1/16 px, both ways; no stripe is formed anew.

    Args:
        shapes: of the same N points on each of S sensors.
        pixels: pixels of a line.
    """
    width = max(shape.cell_sr.shape[1] for shape in shapes) // CELLS + 2
    cells = np.zeros((len(shapes[0].first_px), len(shapes), width * CELLS))
    for sensor, shape in enumerate(shapes):
        # A dark pixel before and after, for what is shifted out.
        cells[:, sensor, CELLS : CELLS + shape.cell_sr.shape[1]] = shape.cell_sr
    first = np.stack([shape.first_px - 1 for shape in shapes], axis=1)
    mean = cells.reshape(*first.shape, width, CELLS).sum(axis=3)
    # Moved up by a cell, a pixel loses its last cell and gains its neighbour's; down, likewise.
    foremost, last = cells[..., ::CELLS], cells[..., CELLS - 1 :: CELLS]
    slope = foremost - last
    slope[..., 1:] += last[..., :-1]
    slope[..., :-1] -= foremost[..., 1:]
    slope *= CELLS / 2.0
    pixel = first[..., None] + np.arange(width)
    beyond = (pixel < 0) | (pixel >= pixels)
    mean[beyond], slope[beyond] = 0.0, 0.0
    return Stripes(first, mean, slope)


def _displacement(cameras: CameraStack, points_mm: Array) -> tuple[Array, float]:
    """Return a direction and step that move the stripes on all sensors by about SHIFT_PX.

    Raises:
        InvalidParameter: no sensor sees the centre of the points.
    """
    centre = points_mm.mean(axis=0)
    per_mm = cameras.linearise(centre[None])[1][0]
    per_mm = per_mm[np.isfinite(per_mm).all(axis=1)]
    if len(per_mm) == 0:
        raise InvalidParameter(
            f"no sensor sees the middle of the points, {centre.tolist()} mm; they must lie in "
            "front of the sensors",
            points_mm=centre.tolist(),
        )
    # No sensor may measure across the direction: of many in a plane that all see well, the best.
    _, _, axes = np.linalg.svd(per_mm)
    directions = np.column_stack([np.cos(_DIRECTION_ANGLES), np.sin(_DIRECTION_ANGLES)]) @ axes[:2]
    moved = np.abs(directions @ per_mm.T)
    best = int(moved.min(axis=1).argmax())
    return directions[best], SHIFT_PX / float(moved[best].max())


def centroids(lines: PixelSolidAngles, pixels: int) -> tuple[Array, Array]:
    """Return the centroids of whole stripes and their light on the pixels.

    Args:
        lines: stripes of N points on S sensors.
        pixels: number of pixels of a sensor.

    Returns:
        Centroids [px], including light beyond the sensor's end, NaN without light; and light on the
        pixels [sr]; both of shape (N, S).
    """
    pixel = lines.first_px[..., None] + np.arange(lines.solid_angle_sr.shape[2])
    light = lines.solid_angle_sr.sum(axis=2)
    inside = (lines.solid_angle_sr * ((pixel >= 0) & (pixel < pixels))).sum(axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        position = (lines.solid_angle_sr * pixel).sum(axis=2) / light
    return position, inside


def _in_window(lines: PixelSolidAngles, first: NDArray[np.int64], width: int, pixels: int) -> Array:
    """Return the stripes in windows that begin at ``first``, zero beyond the sensor's ends."""
    points, sensors, line_pixels = lines.solid_angle_sr.shape
    window = np.zeros((points, sensors, width))
    column = (lines.first_px - first)[..., None] + np.arange(line_pixels)
    np.put_along_axis(window, column, lines.solid_angle_sr, axis=2)
    pixel = first[..., None] + np.arange(width)
    window[(pixel < 0) | (pixel >= pixels)] = 0.0
    return window


def centre_of_gravity_sigma(
    mean_electrons: Array, noise: PixelNoise, settings: CentroidSettings
) -> Array:
    """Return the standard deviation that the centroid finder reports for stripes, shape (L,) [px].

    For threshold and centre of gravity (thesis [4.1]): noise, and the error that depends on where
    the stripe falls within the pixels, which more light does not reduce. NaN where the stripe is
    too faint to be detected, or cut by the sensor's end.

    Args:
        mean_electrons: mean signal, shape (L, W).
        noise: noise of a pixel in addition to shot noise.
        settings: settings of the centroid finder.

    Raises:
        InvalidParameter: ``noise`` has no gain.
    """
    check_positive(noise, "electrons_per_count")
    width = mean_electrons.shape[-1]
    # Enough dark groups beside the line for the finder's background.
    length = max(4 * width, SAMPLE_GROUPS * GROUP_PIXELS)
    counts = np.full((len(mean_electrons), length), float(noise.background_electrons))
    start = (length - width) // 2
    counts[:, start : start + width] += mean_electrons
    counts = np.rint(counts / noise.electrons_per_count).clip(0, 65535)
    model = SensorNoise.of(noise.electrons_per_count, noise.read_noise_electrons)
    peaks = find_peaks_reference(counts.astype(np.uint16), settings, model)
    brightest = np.argmax(np.nan_to_num(peaks.amplitude, nan=-1.0), axis=1)
    return np.take_along_axis(peaks.sigma_px, brightest[:, None], axis=1)[:, 0].astype(np.float64)
