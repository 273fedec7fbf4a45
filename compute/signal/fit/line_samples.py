"""LineSamples: pixels about single lines, with each line's position, light and background."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.signal.fit.fit_finder import FitFinder
from compute.signal.fit.fit_settings import SURROUNDING_PIXELS, FitSettings
from compute.signal.peaks import PeakFlag
from compute.signal.pixel_corrections import PixelCorrections
from compute.signal.sensor_noise import QUANTISATION_VARIANCE, SensorNoise

Array = NDArray[np.float64]

MAX_LINES: Final = 8000
REACH_WIDTHS: Final = 9.0
"""Half a window, in the lines' standard deviations."""
_BATCH: Final = 512
_UNCLEAR: Final = (
    PeakFlag.SATURATED | PeakFlag.CLIPPED | PeakFlag.MERGED | PeakFlag.TRUNCATED
    | PeakFlag.UNFITTED | PeakFlag.JOINT | PeakFlag.AMBIGUOUS
)  # fmt: skip
_STEP_PX: Final = 0.2


@dataclass(eq=False)
class LineSamples:
    """L lines in windows of W pixels; positions, lights and backgrounds are moved in place.

    Args:
        values: counts, corrected, shape (L, W).
        used: pixels that count: neither masked nor outside of the sensor, shape (L, W).
        scale: factors of the pixels' corrections, shape (L, W).
        pixel_offset: numbers of the pixels, shape (L, W).
        position_px: shape (L,).
        light: counts of each line, shape (L,).
        level: background at the line's pixel, shape (L,).
        slope: of the background [counts/px], shape (L,).
        width_px: standard deviation of the lines, by a Gaussian [px].
        reach_px: half a window [px].
        dark_variance: of a pixel without light [counts^2].
        electrons_per_count: gain.
        offset_counts: count without light.
    """

    values: Array
    used: NDArray[np.bool_]
    scale: Array
    pixel_offset: Array
    position_px: Array
    light: Array
    level: Array
    slope: Array
    width_px: float
    reach_px: float
    dark_variance: float
    electrons_per_count: float
    offset_counts: float

    def __post_init__(self) -> None:
        self.centre = np.rint(self.position_px)

    def predict(self, share: Array, lines: NDArray[np.intp]) -> tuple[Array, Array]:
        """Return expected counts and weights of pixels.

        Args:
            share: of the lines' light, shape (N, W).
            lines: numbers of the N lines.
        """
        away = self.pixel_offset[lines] - self.centre[lines][:, None]
        mean = self.level[lines][:, None] + self.slope[lines][:, None] * away
        mean = mean + self.light[lines][:, None] * share
        above = np.maximum(mean - self.offset_counts, 0.0) / self.electrons_per_count
        scale = self.scale[lines]
        variance = scale * (scale * self.dark_variance + above)
        return mean, np.where(self.used[lines], 1.0 / variance, 0.0)

    def move(self, step: Array) -> None:
        """Move position, light and level of the lines by steps, shape (L, 3)."""
        self.position_px = self.position_px + np.clip(step[:, 0], -_STEP_PX, _STEP_PX)
        self.light = self.light + step[:, 1]
        self.level = self.level + step[:, 2]


def take_samples(
    scans: NDArray[np.uint16],
    settings: FitSettings,
    noise: SensorNoise,
    corrections: PixelCorrections | None,
) -> LineSamples:
    """Return the lines of scans that have one clear line alone, MAX_LINES of them at most.

    Args:
        scans: counts of one sensor, shape (F, P).
        settings: of the fit by a Gaussian.
        noise: of the sensor, one.
        corrections: of its pixels; None: counts are taken as they are.

    Raises:
        InvalidParameter: the scans have another type or shape.
    """
    pixels = scans.shape[1]
    finder = FitFinder(_BATCH, pixels, settings, noise, None, "cpu", 1, corrections)
    parts = [finder.find(scans[at : at + _BATCH]) for at in range(0, len(scans), _BATCH)]
    count, position, flags, width = (
        np.concatenate([getattr(one, name) for one in parts])
        for name in ("count", "position_px", "flags", "width_px")
    )
    amplitude = np.concatenate([one.amplitude for one in parts])
    # Full width at the search's threshold, over that of a Gaussian.
    unit = 2.0 * np.sqrt(-2.0 * np.log(settings.search.threshold_fraction))
    clear = (count == 1) & ((flags[:, 0] & int(_UNCLEAR)) == 0)
    sigma = float(np.median(width[clear, 0])) / unit if clear.any() else 1.0
    reach = int(np.ceil(REACH_WIDTHS * sigma)) + 1
    near = np.nan_to_num(position[:, 0], nan=-1.0)
    clear &= (near > reach) & (near < pixels - 1 - reach)
    chosen = np.flatnonzero(clear)
    if len(chosen) > MAX_LINES:
        chosen = chosen[np.linspace(0, len(chosen) - 1, MAX_LINES).astype(np.intp)]
    at = np.rint(near[chosen]).astype(np.intp)[:, None] + np.arange(-reach, reach + 1)
    raw = scans[chosen[:, None], at]
    values, scale = raw.astype(np.float64), np.ones(at.shape)
    counts = scans[chosen].astype(np.float64)
    if corrections is not None:
        counts = corrections.correct(scans[chosen]).astype(np.float64)
        values = np.take_along_axis(counts, at, axis=1)
        scale = corrections.scale[0, at].astype(np.float64)
    used = (scale != 0.0) & (raw < noise.full_scale_counts[0])
    gain, read = float(noise.electrons_per_count[0]), float(noise.read_noise_electrons[0])
    level = 0.5 * (values[:, :2].mean(axis=1) + values[:, -2:].mean(axis=1))
    slope = _surrounding_slope(counts, at[:, 0], at[:, -1])
    return LineSamples(
        values,
        used,
        np.where(scale == 0.0, 1.0, scale),
        at.astype(np.float64),
        near[chosen],
        amplitude[chosen, 0].astype(np.float64) * sigma * np.sqrt(2.0 * np.pi),
        level,
        slope,
        sigma,
        float(reach),
        (read / gain) ** 2 + QUANTISATION_VARIANCE,
        gain,
        float(noise.offset_counts[0]),
    )


def _surrounding_slope(counts: Array, first: NDArray[np.intp], last: NDArray[np.intp]) -> Array:
    """Return the background's slope by SURROUNDING_PIXELS on either side; 0 near the sensor's ends.

    It is not fitted with the line: far from it, slope and shape are hard to tell apart.
    """
    pixels = counts.shape[1]
    side = np.arange(1, SURROUNDING_PIXELS + 1)
    inside = (first - side[-1] >= 0) & (last + side[-1] < pixels)
    below, above = (
        np.median(np.take_along_axis(counts, np.clip(at, 0, pixels - 1), axis=1), axis=1)
        for at in (first[:, None] - side, last[:, None] + side)
    )
    distance = last - first + SURROUNDING_PIXELS + 1.0
    return np.where(inside, (above - below) / distance, 0.0)
