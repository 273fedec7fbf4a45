"""Search for a known pattern in scans, to the pixel, by cross-correlation."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft

from compute.errors import InvalidParameter
from compute.signal.coded_aperture.shadow_template import ShadowTemplate

Array = NDArray[np.float64]

MIN_CONTRAST_FRACTION: Final = 0.1
"""Share of the pattern's contrast, of what a scan can hold at best, that must be on the scan."""


@dataclass(frozen=True, eq=False)
class CorrelationPeak:
    """Shifts of the highest correlation in L scans.

    Args:
        shift_px: shift with the highest correlation, refined by a parabola, shape (L,) [px].
        height: correlation there over the root of the pattern's contrast on the scan, shape
            (L,): in noise of deviation s a pixel it is normal with the deviation s.
        second_height: the highest outside the main lobe, the same way, shape (L,); zero or more.
    """

    shift_px: Array
    height: Array
    second_height: Array


class ShadowSearch:
    """Correlation of scans with a template at all whole shifts, thesis [2.16] to [2.18].

    ``R(m) / sqrt(C(m))`` with ``R(m) = sum (v_n - mean v) x_(n-m)`` by the cross-power
    spectrum and the contrast C(m) of what the scan shows of the pattern at the shift m: squared,
    it is by how much the pattern there, with the best brightness over the best even background,
    lowers the sum of squares. A pattern half off the scan is thus compared fairly.

    Args:
        template: the pattern.
        pixels: pixels of a scan.

    Raises:
        InvalidParameter: a scan that is too short.
    """

    def __init__(self, template: ShadowTemplate, pixels: int) -> None:
        if pixels < 8:
            raise InvalidParameter(
                f"a scan has {pixels} pixels; it must have 8 or more", pixels=pixels
            )
        model = template.pixel_values
        if not template.dark_beyond:
            # Nothing is known of the rest: let it be as bright as the mean.
            model = model - model.mean()
        self.pixels = pixels
        # Shifts that leave a pixel of the template on the scan.
        lowest = -template.first_px - len(model) + 1
        self._shifts = lowest + np.arange(pixels + len(model) - 1)
        self._size = next_fast_len(pixels + len(model) - 1, real=True)
        self._index = (self._shifts + template.first_px) % self._size
        self._spectrum = rfft(model, self._size).conj()
        contrast = self._contrast(model)
        self.shares = contrast / contrast.max()
        """Contrast on the scan at each whole shift, relative to the largest, shape (M,)."""
        contrasted = self.shares >= MIN_CONTRAST_FRACTION
        self.lowest_px, self.highest_px = (int(self._shifts[contrasted][end]) for end in (0, -1))
        """First and last shift that are looked at."""
        with np.errstate(divide="ignore"):
            self._per_contrast = np.where(contrasted, 1.0 / np.sqrt(contrast), 0.0)
        self.lobe_px = self._lobe(model - model.mean())
        """Shift at which the pattern's correlation with itself ceases to fall."""

    @property
    def count(self) -> int:
        """Number of shifts that are searched."""
        return self.highest_px - self.lowest_px + 1

    def share(self, shift_px: Array) -> Array:
        """Return the share of the contrast on the scan at the nearest whole shift, shape (L,)."""
        first, last = float(self._shifts[0]), float(self._shifts[-1])
        index = np.rint(np.clip(shift_px, first, last) - first).astype(np.int64)
        return np.asarray(self.shares[index])

    @property
    def first_shift_px(self) -> int:
        """The shift of the first of ``heights`` [px]."""
        return int(self._shifts[0])

    def heights(self, values: Array) -> Array:
        """Return ``CorrelationPeak.height`` at every whole shift, (L, M); 0 where not searched.

        Args:
            values: scans, shape (L, P) [counts].
        """
        even = values - values.mean(axis=1, keepdims=True)
        correlation = irfft(rfft(even, self._size) * self._spectrum, self._size)
        return np.asarray(correlation[:, self._index] * self._per_contrast)

    def find(self, values: Array) -> CorrelationPeak:
        """Search scans of shape (L, P) [counts]."""
        return self.highest(self.heights(values))

    def highest(self, heights: Array) -> CorrelationPeak:
        """Return where ``heights`` are highest, shape (L, M)."""
        heights = heights.copy()
        best = heights.argmax(axis=1)
        row = np.arange(len(heights))
        inner = np.clip(best, 1, heights.shape[1] - 2)
        before, at, after = (heights[row, inner + step] for step in (-1, 0, 1))
        bend = before - 2.0 * at + after
        with np.errstate(divide="ignore", invalid="ignore"):
            part = np.where(bend < 0.0, 0.5 * (before - after) / bend, 0.0)
        top = heights[row, best].copy()
        lobe = np.arange(-self.lobe_px, self.lobe_px + 1)
        heights[row[:, None], np.clip(best[:, None] + lobe, 0, heights.shape[1] - 1)] = 0.0
        return CorrelationPeak(
            self._shifts[inner] + np.clip(part, -1.0, 1.0),
            top,
            np.maximum(heights.max(axis=1), 0.0),
        )

    def _contrast(self, model: Array) -> Array:
        """Return the squares about the mean of what the scan shows, at each shift."""
        once, twice = (np.concatenate([[0.0], np.cumsum(v)]) for v in (model, model**2))
        # Which of the template's pixels lies on the scan's first.
        first = len(model) - 1 - np.arange(len(self._shifts))
        start, stop = np.maximum(first, 0), np.minimum(first + self.pixels, len(model))
        sums, squares = once[stop] - once[start], twice[stop] - twice[start]
        return np.asarray(np.maximum(squares - sums**2 / self.pixels, 0.0))

    def _lobe(self, model: Array) -> int:
        autocorrelation = irfft(np.abs(rfft(model, self._size)) ** 2, self._size)[: self._size // 2]
        rising = np.flatnonzero(np.diff(autocorrelation) >= 0.0)
        return int(rising[0]) if len(rising) else len(autocorrelation)
