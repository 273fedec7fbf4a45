"""The noise that lines are reckoned with: as given, or guessed from the lines themselves."""

import numpy as np
from numpy.typing import NDArray

from compute.signal.detection.line_spread import line_spread
from compute.signal.noise import QUANTISATION_VARIANCE, LineNoise
from compute.signal.settings import GROUP_PIXELS, LEVEL_UNIT, CentroidSettings, sample_starts
from service.line_scans.schema import PixelNoise

Array = NDArray[np.float64]
Lines = NDArray[np.uint16]


def guessed_noise(lines: Lines) -> tuple[PixelNoise, list[str]]:
    """Return noise that explains lines (L, P) between their peaks, and what was assumed.

    One line says how its pixels vary at the background; what light adds, it does not. If all
    the background is light and all its noise photon noise, the gain is the background over the
    variance; but no gain is less than one electron a count, and the rest is read noise.
    """
    spread = line_spread(lines)
    variance = float(np.median(spread.variance())) - QUANTISATION_VARIANCE
    background = float(np.median(spread.background)) / LEVEL_UNIT
    gain = background / variance
    read = 0.0
    if gain < 1.0:
        gain, read = 1.0, (variance - background) ** 0.5
    largest = int(lines.max())
    full = 2 ** max(largest.bit_length(), 8) - 1
    noise = PixelNoise(electrons_per_count=gain, read_noise_electrons=read, full_scale_counts=full)
    pixel_sigma = (variance + QUANTISATION_VARIANCE) ** 0.5
    assumed = [
        f"noise of a pixel at the background: {pixel_sigma:.3g} counts, measured between the peaks",
        "offset: 0 counts; all of the background is taken for light",
        f"gain: {gain:.3g} electrons per count, as if noise at the background were photon noise",
        f"read noise: {read:.3g} electrons, what photon noise leaves of the noise",
        f"full scale: {full} counts, the next 2^n - 1 not below the largest value, {largest}",
    ]
    return noise, assumed


def line_noise(noise: PixelNoise) -> LineNoise:
    """Return compute's form of it."""
    return LineNoise.of(**noise.model_dump())


def noise_at(noise: PixelNoise, background: Array) -> Array:
    """Return the standard deviations of pixels at backgrounds, same shape [counts]."""
    model = line_noise(noise)
    light = np.maximum(background - noise.offset_counts, 0.0)
    return np.asarray(np.sqrt(model.dark_variance[0] + model.photon_variance[0] * light))


def search_limits(lines: Lines, settings: CentroidSettings, noise: PixelNoise) -> Array:
    """Return what a peak's highest pixel must reach, as CentroidSettings says it, shape (L,)."""
    pixel = np.array(sample_starts(lines.shape[1]))[:, None] + np.arange(GROUP_PIXELS)
    means = np.sort(lines[:, pixel].astype(np.int64).sum(axis=2), axis=1) / GROUP_PIXELS
    background = means[:, (means.shape[1] - 1) // 4]
    spread = background - means[:, (means.shape[1] - 1) // 16]
    sigma = np.maximum(noise_at(noise, background), spread)
    return np.asarray(background + settings.detection_sigma * sigma)
