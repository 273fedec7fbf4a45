"""Noise model of posted scans: given by the client or estimated from the scans."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.signal.centroid_reference import scan_background
from compute.signal.centroid_settings import LEVEL_UNIT, CentroidSettings
from compute.signal.detection.background_estimate import estimate_background
from compute.signal.sensor_noise import QUANTISATION_VARIANCE, SensorNoise
from service.api.line_scans.schema import PixelNoise

Array = NDArray[np.float64]
Scans = NDArray[np.uint16]


@dataclass(frozen=True)
class NoiseConstants:
    """Offset and full scale of a sensor whose gain and read noise are not known; None: not known.

    Args:
        offset_counts: the count without light.
        full_scale_counts: the count of a saturated pixel.
    """

    offset_counts: float | None = None
    full_scale_counts: int | None = None


def estimate_noise(
    scans: Scans, known: NoiseConstants | None = None
) -> tuple[PixelNoise, list[str]]:
    """Return noise that explains scans (L, P) between their peaks, and what was assumed.

    One scan says how its pixels vary at the background; what light adds, it does not. If all
    the background above the offset is light and all its noise photon noise, the gain is that
    light over the variance; but no gain is less than one electron a count, and the rest is read
    noise. No other gain above one says less noise of bright pixels: positions scatter by more.
    """
    known = NoiseConstants() if known is None else known
    offset = 0.0 if known.offset_counts is None else known.offset_counts
    spread = estimate_background(scans)
    variance = float(np.median(spread.variance())) - QUANTISATION_VARIANCE
    light = max(float(np.median(spread.background)) / LEVEL_UNIT - offset, 0.0)
    gain = light / variance
    read = 0.0
    if gain < 1.0:
        gain, read = 1.0, (variance - light) ** 0.5
    largest = int(scans.max())
    full = known.full_scale_counts or 2 ** max(largest.bit_length(), 8) - 1
    noise = PixelNoise(
        electrons_per_count=gain,
        read_noise_electrons=read,
        offset_counts=offset,
        full_scale_counts=full,
    )
    pixel_sigma = (variance + QUANTISATION_VARIANCE) ** 0.5
    assumed = [
        f"noise of a pixel at the background: {pixel_sigma:.3g} counts, measured between the peaks",
        f"gain: {gain:.3g} electrons per count, as if noise at the background were photon noise",
        f"read noise: {read:.3g} electrons, what photon noise leaves of the noise",
    ]
    if known.offset_counts is None:
        assumed.append("offset: 0 counts; all of the background is taken for light")
    if known.full_scale_counts is None:
        assumed.append(
            f"full scale: {full} counts, the next 2^n - 1 not below the largest value, {largest}"
        )
    if gain > 1.0:
        better = "" if known.offset_counts is not None else "; a known offset repairs most of it"
        assumed.append(
            "standard deviations are lower limits: the gain is the greatest that the noise "
            f"allows{better}"
        )
    return noise, assumed


def line_noise(noise: PixelNoise) -> SensorNoise:
    """Return compute's form of it."""
    return SensorNoise.of(**noise.model_dump())


def noise_at(noise: PixelNoise, background: Array) -> Array:
    """Return the standard deviations of pixels at backgrounds, same shape [counts]."""
    model = line_noise(noise)
    light = np.maximum(background - noise.offset_counts, 0.0)
    return np.asarray(np.sqrt(model.dark_variance[0] + model.photon_variance[0] * light))


def search_limits(scans: Scans, settings: CentroidSettings, noise: PixelNoise) -> Array:
    """Return what a peak's highest pixel must reach, as CentroidSettings says it, shape (L,).

    Where the background of a scan slopes, it holds in the scan's middle.
    """
    levels = np.array([scan_background(scan.astype(np.int64))[:2] for scan in scans])
    background, spread = levels.T / LEVEL_UNIT
    sigma = np.maximum(noise_at(noise, background), spread)
    return np.asarray(background + settings.detection_sigma * sigma)
