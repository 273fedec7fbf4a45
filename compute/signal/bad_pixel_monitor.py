"""Bad pixels of a sensor from scans with moving lights, without dark or flat captures."""

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from compute.parameter_checks import require, require_shape
from compute.signal.radiometric_calibration import (
    MAX_BAD_SHARE,
    BadPixel,
    RadiometricCalibration,
    running_median,
)

Array = NDArray[np.float64]

MIN_SCANS: Final = 256
"""Scans before anything is said. A pixel with a noise of half a count stays the same so long with a
probability below 1e-40."""
MIN_CHANGE_COUNTS: Final = 3.0
"""Median range of the neighbours' counts from which a pixel that never changes is stuck: that of
MIN_SCANS scans with a noise of half a count. Where there is less noise, a good pixel may stay."""
EXCESS_SIGMA: Final = 8.0
"""Height of a hot pixel's least count above that of its neighbours, in deviations of a pixel."""
ISOLATED_PART: Final = 0.1
"""Largest part of a hot pixel's excess that its neighbours may have: a still line of 0.4 px or more
has more. Of sharper lines, whose width must be known, half of what they have."""
MIN_LIGHT_SIGMA: Final = 30.0
"""Light that must have passed over a pixel's neighbours before it can be called dead."""
DEAD_PART: Final = 0.3
"""Part of its neighbours' greatest light below which a pixel is dead."""


class BadPixelMonitor:
    """Keeps the least and the greatest count of each pixel and names those that are bad.

    - *Stuck*: the count never changes, while those of other pixels do. At zero, where an offset
      may be cut off, light must have passed over both neighbours; at full scale, where a still
      light may be, the neighbours must be dark.
    - *Hot*: the least count of all scans is far above that of the neighbours, alone: every
      other pixel has seen the background once, or lies in the still light of a line, which covers
      several.
    - *Dead*: light has passed over both neighbours, and the pixel has not seen it.

    It takes a maximum and a minimum a pixel: one scan in many is enough. A pixel that becomes hot
    later is found by a monitor that begins later. Whoever masks what it finds records it with the
    frames from which on it does: a stage that masked pixels by itself would not give the same peaks
    again when a recording is replayed.

    Args:
        pixels: pixels of the sensor.
    """

    def __init__(self, pixels: int) -> None:
        require(pixels >= 1, "be 1 or more", pixels=pixels)
        self._scans = 0
        self._least = np.full(pixels, 65535, np.uint16)
        self._greatest = np.zeros(pixels, np.uint16)

    @property
    def scans(self) -> int:
        """Number of scans so far."""
        return self._scans

    def add(self, scans: NDArray[np.uint16]) -> None:
        """Take scans of the sensor, uint16, shape (F, P).

        Raises:
            InvalidParameter: another shape.
        """
        pixels = len(self._least)
        right = f"be (F, {pixels})"
        require_shape(scans.ndim == 2 and scans.shape[1] == pixels, right, scans=scans)
        if len(scans):
            np.minimum(self._least, scans.min(axis=0), out=self._least)
            np.maximum(self._greatest, scans.max(axis=0), out=self._greatest)
            self._scans += len(scans)

    def find(
        self,
        pixel_sigma_counts: float,
        full_scale_counts: int = 65535,
        line_sigma_px: float | None = None,
    ) -> NDArray[np.uint8]:
        """Return BadPixel flags, shape (P,); none before MIN_SCANS scans.

        Nothing is said either where more than MAX_BAD_SHARE of the pixels would be bad: then the
        scene was not what it must be.

        Args:
            pixel_sigma_counts: standard deviation of a pixel without light [counts].
            full_scale_counts: largest count [counts].
            line_sigma_px: standard deviation of the sharpest lines [px]; None: 0.4 or more.

        Raises:
            InvalidParameter: a value is not positive.
        """
        require(0.0 < pixel_sigma_counts < np.inf, "be positive", sigma=pixel_sigma_counts)
        bad = np.zeros(len(self._least), np.uint8)
        if self._scans < MIN_SCANS:
            return bad
        least, greatest = self._least.astype(np.float64), self._greatest.astype(np.float64)
        changed = greatest - least
        level = running_median(least)

        excess = least - level
        isolated = _greater_neighbour(excess) < _isolated_part(line_sigma_px) * excess
        light = greatest - level
        around = np.minimum(np.roll(light, 1), np.roll(light, -1))
        around[[0, -1]] = 0.0
        lit = around > MIN_LIGHT_SIGMA * pixel_sigma_counts

        stuck = (changed == 0.0) & (running_median(changed) >= MIN_CHANGE_COUNTS)
        stuck &= (least > 0.0) | lit
        stuck &= (least < full_scale_counts) | isolated
        hot = ~stuck & isolated & (excess > EXCESS_SIGMA * pixel_sigma_counts)
        dead = ~stuck & ~hot & lit & (light < DEAD_PART * around)
        for kind, where in (
            (BadPixel.STUCK, stuck),
            (BadPixel.HOT, hot),
            (BadPixel.DEAD, dead),
        ):
            bad[where] |= np.uint8(kind)
        return bad if np.mean(bad != 0) <= MAX_BAD_SHARE else np.zeros_like(bad)


def masking_calibration(
    bad_pixels: NDArray[np.uint8],
    electrons_per_count: float,
    read_noise_electrons: float,
    offset_counts: float,
    saturation_counts: int,
) -> RadiometricCalibration:
    """Return a calibration that masks bad pixels and takes all others for equal.

    Args:
        bad_pixels: BadPixel flags, uint8, shape (P,).
        electrons_per_count: by the data sheet.
        read_noise_electrons: by the data sheet.
        offset_counts: count without light, by the data sheet.
        saturation_counts: count at which a pixel is saturated.

    Raises:
        InvalidParameter: a value outside its range.
    """
    require(electrons_per_count > 0.0, "be positive", electrons_per_count=electrons_per_count)
    variance = (read_noise_electrons / electrons_per_count) ** 2 + 1.0 / 12.0
    pixels = len(bad_pixels)
    return RadiometricCalibration(
        dark_offset=np.full(pixels, float(offset_counts)),
        response=np.ones(pixels),
        gain_electrons_per_count=electrons_per_count,
        read_noise_counts=float(np.sqrt(variance)),
        saturation_counts=saturation_counts,
        linearity=(0.0, 0.0),
        bad_pixels=bad_pixels,
        captures=0,
        dsnu_counts=0.0,
        prnu=0.0,
        response_sigma=0.0,
    )


def _isolated_part(line_sigma_px: float | None) -> float:
    """Return the part of its excess that a hot pixel's neighbours may have at most."""
    if line_sigma_px is None:
        return ISOLATED_PART
    # A still line at the middle of a pixel.
    centre = 2.0 * float(ndtr(0.5 / line_sigma_px)) - 1.0
    beside = float(ndtr(1.5 / line_sigma_px) - ndtr(0.5 / line_sigma_px))
    return min(ISOLATED_PART, 0.5 * beside / centre)


def _greater_neighbour(values: Array) -> Array:
    padded = np.pad(values, 1, mode="edge")
    padded[[0, -1]] = -np.inf
    return np.maximum(padded[:-2], padded[2:])
