"""Simulated scans of one peak at every phase within a pixel."""

from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from compute.signal.centroid_finder import CentroidFinder
from compute.signal.centroid_settings import CentroidSettings
from compute.signal.peaks import PeakBatch
from compute.signal.sensor_noise import SensorNoise

Array = NDArray[np.float64]

PIXELS: Final = 128
GAIN: Final = 10.0
"""Electrons per count."""
OFFSET: Final = 100.0
"""Counts without light."""
AMBIENT: Final = 20.0
"""Electrons of ambient light in a pixel."""
FULL_SCALE: Final = 65535
MIDDLE_PX: Final = 64

_BLOCK: Final = 2000
_NEAR_WIDTHS: Final = 3.0  # a candidate so near is the line's


def line_noise(read_electrons: float) -> SensorNoise:
    """Return the noise of the exposures."""
    return SensorNoise.of(GAIN, read_electrons, OFFSET, FULL_SCALE)


def gaussian_electrons(position_px: Array, width_px: float, light: tuple[float, ...]) -> Array:
    """Return the mean electrons of K Gaussian lines without ambient light, shape (N, PIXELS).

    Args:
        position_px: shape (N, K).
        width_px: their deviation.
        light: electrons of each.
    """
    edge = np.arange(PIXELS + 1) - 0.5
    mean = np.zeros((len(position_px), PIXELS))
    for k, electrons in enumerate(light):
        mean += electrons * np.diff(ndtr((edge - position_px[:, k, None]) / width_px), axis=1)
    return mean


def expose(electrons: Array, read_electrons: float, rng: np.random.Generator) -> NDArray[np.uint16]:
    """Return counts: photon noise of light and ambient light, read noise, offset, rounding."""
    seen = rng.poisson(electrons + AMBIENT) + read_electrons * rng.standard_normal(electrons.shape)
    return np.clip(np.rint(seen / GAIN + OFFSET), 0, FULL_SCALE).astype(np.uint16)


def places_px(count: int, rng: np.random.Generator) -> Array:
    """Return positions all over the middle pixel, evenly but by chance, shape (N,)."""
    return MIDDLE_PX - 0.5 + (np.arange(count) + rng.uniform(0.0, 1.0, count)) / count


@cache
def _finder(settings: CentroidSettings, read_electrons: float) -> CentroidFinder:
    return CentroidFinder(_BLOCK, PIXELS, settings, line_noise(read_electrons), "cpu")


def find(lines: NDArray[np.uint16], settings: CentroidSettings, read_electrons: float) -> PeakBatch:
    """Return what the search finds, a block of lines at a time."""
    finder = _finder(settings, read_electrons)
    parts = []
    for start in range(0, len(lines), _BLOCK):
        block = lines[start : start + _BLOCK]
        rows = np.zeros((_BLOCK, PIXELS), np.uint16)
        rows[: len(block)] = block
        found = finder.find(rows)
        parts.append({name: values[: len(block)] for name, values in vars(found).items()})
    return PeakBatch(**{name: np.concatenate([part[name] for part in parts]) for name in parts[0]})


@dataclass(frozen=True, eq=False)
class Nearest:
    """The peak nearest to the line's true place.

    Args:
        peaks: it alone, one a line; where none is near, a made up one: see ``nearest``.
        found: one was near, shape (N,).
    """

    peaks: PeakBatch
    found: NDArray[np.bool_]


def nearest(
    found: PeakBatch,
    position_px: Array,
    width_px: float,
    amplitude: float,
    rng: np.random.Generator,
) -> Nearest:
    """Return the peaks nearest to true places, within three widths.

    Where none is, a start for a fit is made up, as by a matched filter: the true place with a
    normal error of a third of the width, the true width and amplitude.

    Args:
        found: peaks of N lines.
        position_px: true places, shape (N,).
        width_px: true deviation.
        amplitude: true maximum [counts].
        rng: of the errors.
    """
    error = np.where(
        np.isnan(found.position_px), np.inf, np.abs(found.position_px - position_px[:, None])
    )
    best = np.argmin(error, axis=1)
    row = np.arange(len(best))
    near = error[row, best] < _NEAR_WIDTHS * max(width_px, 1.0)
    one = PeakBatch.empty(len(best), 1)
    one.count[:] = 1
    for name in ("position_px", "sigma_px", "amplitude", "width_px", "flags"):
        getattr(one, name)[:, 0] = getattr(found, name)[row, best]
    missing = np.flatnonzero(~near)
    one.position_px[missing, 0] = position_px[missing] + rng.normal(
        0.0, width_px / 3.0, len(missing)
    )
    one.sigma_px[missing] = width_px / 3.0
    one.amplitude[missing] = amplitude
    one.width_px[missing] = 2.0 * np.sqrt(2.0 * np.log(3.0)) * width_px
    one.flags[missing] = 0
    return Nearest(one, near)
