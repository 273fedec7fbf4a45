"""Line bound: how precisely a line's position can be read at best, and by centre of gravity."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.optics.footprints import Footprints
from compute.signal.noise import LineNoise
from compute.signal.reference import find_peaks_reference
from compute.signal.settings import GROUP_PIXELS, SAMPLE_GROUPS, CentroidSettings

Array = NDArray[np.float64]

SHIFT_PX = 0.05
"""By how much lines are moved, both ways, to take their derivative. The error of the central
difference is about (SHIFT_PX / s)^2 / 6 of it for a line of deviation s: 0.2 % for 0.5 px."""


_AROUND = np.vstack([np.zeros(3), np.eye(3)])


class FootprintOptics(Protocol):
    """What forms the light lines: ideal, traced, or a mask."""

    def footprints(self, points_mm: Array) -> Footprints:
        """Return the footprints of points (N, 3) in the world frame [mm]."""
        ...


@dataclass(frozen=True)
class PixelNoise:
    """Noise of a pixel apart from the signal's own.

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

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 <= value < np.inf:
                raise InvalidParameter(
                    f"{name} is {value}; it must be zero or positive", **{name: value}
                )
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


def position_bound(mean_electrons: Array, slope_per_px: Array, noise: PixelNoise) -> Array:
    """Return the Cramer-Rao bound of a line's position, its brightness unknown too.

    With a_i = d mu_i / dx and b_i = mu_i (the derivative by the relative brightness),
    ``1 / bound^2 = A - B^2 / C`` where A, B, C are the sums of a a, a b and b b over pixels,
    each over the pixel's variance ``mu + background + read^2 + gain^2 / 12`` (S. M. Kay,
    Fundamentals of Statistical Signal Processing I, 1993, section 3.7). A alone is the
    information where the brightness is known; B is zero for a symmetric line. The variances are
    taken as known: their own dependence on the position, of order 1 / electrons, is left out.

    This is the noise only. An error that is the same in every exposure, such as distortion, the
    shape's dependence on the place, or an estimator's error within a pixel, is not in it.

    Args:
        mean_electrons: signal of each pixel of the window, shape (..., W).
        slope_per_px: derivative by the line's position, shape (..., W) [electrons/px].
        noise: what is noise besides the signal's own.

    Returns:
        Standard deviation, shape (...) [px]; infinite where there is no light.
    """
    variance = np.maximum(mean_electrons, 0.0) + noise.variance_electrons2
    own = (slope_per_px**2 / variance).sum(axis=-1)
    mixed = (slope_per_px * mean_electrons / variance).sum(axis=-1)
    bright = (mean_electrons**2 / variance).sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        information = own - np.where(bright > 0.0, mixed**2 / bright, 0.0)
        bound: Array = np.where(information > 0.0, information, 0.0) ** -0.5
    return bound


@dataclass(frozen=True, eq=False)
class LineReadings:
    """What S sensors read of N points: line, place, and how the place moves with the point.

    Args:
        mean_sr: the lines in the pixels [sr], shape (N, S, W); zero beyond the sensor's ends.
        slope_sr_per_px: derivative of these by the line's position, shape (N, S, W).
        position_px: centres of gravity of the whole lines, shape (N, S); NaN without light.
        slope_px_per_mm: d position / d point, shape (N, S, 3); NaN without light.
        share: share of each line's light that falls on pixels, shape (N, S).
    """

    mean_sr: Array
    slope_sr_per_px: Array
    position_px: Array
    slope_px_per_mm: Array
    share: Array


def line_readings(optics: FootprintOptics, points_mm: Array, pixels: int) -> LineReadings:
    """Move each point a little along X, Y and Z, and see how its lines move.

    The derivative of what each pixel gets is taken from lines that were formed anew, so it holds
    for any shape, however narrow against a pixel. One step serves all points; it moves the lines of
    the middle of them by SHIFT_PX at most.

    Args:
        optics: forms the lines.
        points_mm: shape (N, 3) [mm].
        pixels: pixels of a line.
    """
    here = optics.footprints(points_mm)
    position, light, share = _centroid(here, pixels)
    step = _step_mm(optics, points_mm, pixels)
    gradient = np.empty((*position.shape, 3))
    lines: list[tuple[Footprints, Footprints]] = []
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        ahead, behind = optics.footprints(points_mm + shift), optics.footprints(points_mm - shift)
        change = _centroid(ahead, pixels)[0] - _centroid(behind, pixels)[0]
        gradient[..., axis] = change / (2.0 * step)
        lines.append((ahead, behind))
    windows = [here, *(line for pair in lines for line in pair)]
    first = np.min([window.first_px for window in windows], axis=0)
    last = np.max([w.first_px + w.solid_angle_sr.shape[2] for w in windows], axis=0)
    width = int((last - first).max(initial=1))
    mean = _in_window(here, first, width, pixels)
    squared = (gradient**2).sum(axis=2)
    slope = np.zeros_like(mean)
    for axis, (ahead, behind) in enumerate(lines):
        change = _in_window(ahead, first, width, pixels) - _in_window(behind, first, width, pixels)
        # A step along the gradient g of length 1/|g| moves the line by one pixel.
        with np.errstate(divide="ignore", invalid="ignore"):
            part = (gradient[..., axis] / squared)[..., None] * change / (2.0 * step)
        slope += np.where(np.isfinite(part), part, 0.0)
    dark = ~(light > 0.0) | ~np.isfinite(squared)
    gradient[dark] = np.nan
    return LineReadings(mean, slope, np.where(dark, np.nan, position), gradient, share)


def _step_mm(optics: FootprintOptics, points_mm: Array, pixels: int) -> float:
    """Return a step [mm] that moves lines by about SHIFT_PX in the middle of the points.

    Raises:
        InvalidParameter: no sensor sees the middle of the points.
    """
    middle = points_mm.mean(axis=0)
    trial = 1e-4 * max(1.0, float(np.linalg.norm(middle)))
    places = _centroid(optics.footprints(middle + trial * _AROUND), pixels)[0]
    per_mm = (places[1:] - places[0]) / trial
    if not np.isfinite(per_mm).any():
        raise InvalidParameter(
            f"no sensor sees the middle of the points, {middle.tolist()} mm; the volume must lie "
            "in front of the sensors",
            points_mm=middle.tolist(),
        )
    longest = float(np.sqrt(np.nansum(per_mm**2, axis=0)).max())
    return SHIFT_PX / longest


def _centroid(lines: Footprints, pixels: int) -> tuple[Array, Array, Array]:
    """Return centres of gravity [px], light on the pixels [sr] and its share, each (N, S)."""
    place = lines.first_px[..., None] + np.arange(lines.solid_angle_sr.shape[2])
    light = lines.solid_angle_sr.sum(axis=2)
    inside = (lines.solid_angle_sr * ((place >= 0) & (place < pixels))).sum(axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        position = (lines.solid_angle_sr * place).sum(axis=2) / light
        share = np.where(light > 0.0, inside / light, 0.0)
    return position, inside, share


def _in_window(lines: Footprints, first: NDArray[np.int64], width: int, pixels: int) -> Array:
    """Return the lines in windows that begin at ``first``, zero beyond the sensor's ends."""
    points, sensors, own = lines.solid_angle_sr.shape
    window = np.zeros((points, sensors, width))
    column = (lines.first_px - first)[..., None] + np.arange(own)
    np.put_along_axis(window, column, lines.solid_angle_sr, axis=2)
    place = first[..., None] + np.arange(width)
    window[(place < 0) | (place >= pixels)] = 0.0
    return window


def centre_of_gravity_sigma(
    mean_electrons: Array, noise: PixelNoise, settings: CentroidSettings
) -> Array:
    """Return the standard deviation that ``compute.signal`` gives for lines, shape (L,) [px].

    That of threshold and centre of gravity (thesis [4.1]): noise, and the error by where the
    line falls within the pixels, which more light does not make smaller. NaN where the line is
    too faint to be found, or is cut by the sensor's end into something else.

    Args:
        mean_electrons: mean signal, shape (L, W).
        noise: what is noise besides.
        settings: what counts as a peak, and where it is cut.
    """
    if noise.electrons_per_count <= 0.0:
        raise InvalidParameter(
            f"electrons_per_count is {noise.electrons_per_count}; it must be positive to count",
            electrons_per_count=noise.electrons_per_count,
        )
    width = mean_electrons.shape[-1]
    # Enough dark groups beside the line for the finder's background.
    length = max(4 * width, SAMPLE_GROUPS * GROUP_PIXELS)
    counts = np.full((len(mean_electrons), length), noise.background_electrons)
    start = (length - width) // 2
    counts[:, start : start + width] += mean_electrons
    counts = np.rint(counts / noise.electrons_per_count).clip(0, 65535)
    model = LineNoise.of(noise.electrons_per_count, noise.read_noise_electrons)
    found = find_peaks_reference(counts.astype(np.uint16), settings, model)
    brightest = np.argmax(np.nan_to_num(found.amplitude, nan=-1.0), axis=1)
    return np.take_along_axis(found.sigma_px, brightest[:, None], axis=1)[:, 0].astype(np.float64)
