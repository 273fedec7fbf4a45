"""Matched filter with integer taps for a peak's shape over an unknown background."""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import correlate1d
from scipy.special import ndtr

from compute.errors import InvalidParameter
from compute.parameter_checks import require
from compute.signal.centroid_settings import require_between

Array = NDArray[np.float64]

MAX_ABSOLUTE_SUM: Final = 32768
"""Largest sum of |taps|: times 65535, the largest pixel, it stays below 2^31."""

LENGTH_IN_WIDTHS: Final = 16.0
"""Length of a filter in standard deviations of the peak that it looks for.

The background is estimated under the filter itself, which costs signal-to-noise ratio: a share
1 - sqrt(1 - 3.54 / n) of it for n widths. That is 25 % at 8, 16 % at 12, 12 % at 16 and 9 % at
20; a longer filter takes more neighbours for background."""

_EDGE_OF_SHAPE: Final = 0.05
_WIDTHS_PX: Final = (0.2, 100.0)


@dataclass(frozen=True, eq=False)
class MatchedFilter:
    """Integer taps for the inside of a scan, and for positions near its ends; T = 2 H + 1 taps.

    The answer at a place is ``sum taps_k v_k`` over the pixels from H before to H behind. Near
    an end the window is cut there, and the taps are the matched filter of what is left, again
    orthogonal to a constant; they are scaled to one norm, so that one threshold serves the
    scan. All are whole numbers with sums of |taps| up to 32768: answers to uint16 pixels
    are exact in int32, and every device takes the same decisions.

    Away from the shape the inner taps of a symmetric filter are all ``-level``: a running sum
    gives that part of the answer, and the rest is as short as the shape.

    Args:
        taps: for places H or more from both ends, int64, shape (T,).
        left: row d for the place d < H, on the pixels 0 to T - 1, int64, shape (H, T).
        right: row d for the place P - 1 - d, on the pixels P - T to P - 1, int64, shape (H, T).
        shape: the shape looked for, its largest value 1, float64, shape (T,).
    """

    taps: NDArray[np.int64]
    left: NDArray[np.int64]
    right: NDArray[np.int64]
    shape: Array

    @property
    def half_px(self) -> int:
        """H, the number of pixels that the filter reaches to each side."""
        return len(self.taps) // 2

    @property
    def level(self) -> int:
        """Minus the tap at the filter's end."""
        return -int(self.taps[-1])

    @cached_property
    def norm(self) -> float:
        """Standard deviation of the response to white noise of one count."""
        return float(np.sqrt((self.taps.astype(np.float64) ** 2).sum()))

    @cached_property
    def gain(self) -> float:
        """Response to the shape, one count high, in the middle of the filter."""
        return float(self.taps @ self.shape)

    @cached_property
    def reach_px(self) -> int:
        """Pixels to each side where the shape has more than a twentieth of its maximum."""
        significant = np.flatnonzero(self.shape >= _EDGE_OF_SHAPE) - self.half_px
        return int(abs(significant).max())

    @property
    def snr_of_pixel_snr(self) -> float:
        """Signal-to-noise ratio of the response, relative to that of the shape's highest pixel."""
        return self.gain / self.norm

    @property
    def efficiency(self) -> float:
        """Signal-to-noise ratio, relative to the matched filter over a known background."""
        return self.snr_of_pixel_snr / float(np.sqrt((self.shape**2).sum()))

    def matrix(self, pixels: int) -> NDArray[np.int64]:
        """Return all taps of a scan, shape (P, P): row x for the position x.

        Raises:
            InvalidParameter: the scan is shorter than the filter.
        """
        self._require_room(pixels)
        half, length = self.half_px, len(self.taps)
        rows = np.zeros((pixels, pixels), dtype=np.int64)
        rows[:half, :length] = self.left
        rows[pixels - half :, pixels - length :] = self.right[::-1]
        for pixel in range(half, pixels - half):
            rows[pixel, pixel - half : pixel + half + 1] = self.taps
        return rows

    def gains(self, pixels: int) -> Array:
        """Return the responses at all positions to the shape there, one count high, shape (P,)."""
        self._require_room(pixels)
        half, length = self.half_px, len(self.taps)
        gains = np.full(pixels, self.gain)
        for d in range(half):
            left = np.zeros(length)
            left[: d + half + 1] = self.shape[half - d :]
            gains[d] = self.left[d] @ left
            right = np.zeros(length)
            right[length - (d + half + 1) :] = self.shape[: half + 1 + d]
            gains[pixels - 1 - d] = self.right[d] @ right
        return gains

    def respond(self, scans: NDArray[np.uint16]) -> NDArray[np.int64]:
        """Return the responses at all positions of scans of shape (L, P), int64, same shape.

        Raises:
            InvalidParameter: scans shorter than the filter.
        """
        self._require_room(scans.shape[1])
        half, length = self.half_px, len(self.taps)
        # Whole numbers below 2^53 are exact in float64, in any order of summation.
        values = scans.astype(np.float64)
        answer = correlate1d(values, self.taps.astype(np.float64), axis=1, mode="nearest")
        if half:
            answer[:, :half] = values[:, :length] @ self.left.T
            answer[:, -half:] = (values[:, -length:] @ self.right.T)[:, ::-1]
        return answer.astype(np.int64)

    def _require_room(self, pixels: int) -> None:
        if pixels < len(self.taps):
            raise InvalidParameter(
                f"a scan has {pixels} pixels; the filter needs {len(self.taps)} or more",
                pixels=pixels,
            )


def gaussian_shape(width_px: float, half_px: int, phase_px: float = 0.0) -> Array:
    """Return a Gaussian peak integrated over pixels, unit area, shape (2 half_px + 1,).

    Args:
        width_px: standard deviation [px].
        half_px: pixels to each side of the middle one.
        phase_px: position of the peak from the middle pixel's centre [px].
    """
    edges = np.arange(-half_px, half_px + 2) - 0.5 - phase_px
    return np.asarray(np.diff(ndtr(edges / width_px)), dtype=np.float64)


def gaussian_filter(width_px: float, length_px: int | None = None) -> MatchedFilter:
    """Return the matched filter of Gaussian peaks that are integrated over the pixels.

    Args:
        width_px: standard deviation of the peaks, 0.2 to 100 [px].
        length_px: pixels of the filter, odd; None: LENGTH_IN_WIDTHS widths and one.

    Raises:
        InvalidParameter: a width out of range, a length that is even, or too short for the peak.
    """
    require_between("width_px", width_px, *_WIDTHS_PX)
    half = int(np.ceil(LENGTH_IN_WIDTHS * width_px / 2.0))
    if length_px is not None:
        shortest = 2 * int(np.ceil(2.0 * width_px)) + 1
        require(
            length_px % 2 == 1 and length_px >= shortest,
            f"be odd and at least four widths and one, {shortest}",
            length_px=length_px,
        )
        half = length_px // 2
    shape = gaussian_shape(width_px, half)
    # The normal distribution's two tails differ in their last digits.
    return shape_filter(0.5 * (shape + shape[::-1]))


def shape_filter(shape: ArrayLike, *, slope: bool = False) -> MatchedFilter:
    """Return the matched filter of any shape of a peak.

    Args:
        shape: the peak pixel by pixel, nowhere negative, about the middle of an odd number T
            of pixels; the filter is as long, so its ends should be dark, shape (T,).
        slope: make all taps orthogonal to a straight line. Inside the scan those of a symmetric
            shape are anyhow. Near the ends taps that are not answer to a background that rises
            towards the end; those that are answer to bright peaks elsewhere in the window.

    Raises:
        InvalidParameter: a shape of even length, shorter than 5 pixels, not finite, negative, or
            that is all background.
    """
    peak = np.asarray(shape, dtype=np.float64)
    if peak.ndim != 1 or peak.size < 5 or peak.size % 2 == 0 or peak.size > MAX_ABSOLUTE_SUM // 8:
        raise InvalidParameter(
            f"shape has the shape {peak.shape}; it must have one axis of an odd number of pixels, "
            f"5 to {MAX_ABSOLUTE_SUM // 8}",
            shape=peak.shape,
        )
    least = float(np.min(peak))
    if not (least >= 0.0 and np.isfinite(peak).all()):
        raise InvalidParameter(
            f"shape holds {least}; it must be finite and nowhere negative", shape=least
        )
    half = peak.size // 2
    response = _remove_background(peak, slope=slope)
    ends = [_cut(peak, slope), _cut(peak[::-1], slope)]
    norms = [float(np.sqrt((row**2).sum())) for row in (response, *ends[0], *ends[1])]
    if min(norms) <= 1e-6 * float(peak.max()):
        raise InvalidParameter(
            "shape cannot be told from background in every window that an end of the line cuts; "
            "it must stand out at its middle, over darker ends"
        )
    # Room for what rounding adds to the sum.
    scale = (MAX_ABSOLUTE_SUM - peak.size) / max(
        float(abs(row).sum() / np.sqrt((row**2).sum())) for row in (response, *ends[0], *ends[1])
    )
    floor = -float(response[-1]) / norms[0]
    if floor * scale >= 1.0:
        # The taps beside the shape become whole numbers as they are.
        scale = np.floor(floor * scale) / floor
    inner = _round_taps(scale * response / norms[0], slope=slope)
    left, right = (np.zeros((half, peak.size), dtype=np.int64) for _ in range(2))
    for rows, bank in zip(ends, (left, right), strict=True):
        for d, row in enumerate(rows):
            real = scale * row / float(np.sqrt((row**2).sum()))
            bank[d, : len(row)] = _round_taps(real, slope=slope)
    return MatchedFilter(inner, left, right[:, ::-1].copy(), peak / peak.max())


def _cut(peak: Array, slope: bool) -> list[Array]:
    """Return the filters of a peak on the places 0, 1, ... from a scan's first pixel."""
    half = peak.size // 2
    return [_remove_background(peak[half - d :], slope=slope) for d in range(half)]


def _remove_background(shape: Array, *, slope: bool) -> Array:
    """Return a shape less its mean (and slope), the part that looks like background.

    The result is the matched filter of the shape in white noise over a background that is
    unknown but constant (or straight) under the filter: the projection of the shape on what is
    orthogonal to it.

    Args:
        shape: shape (T,).
        slope: take off the straight line, not the constant alone.
    """
    rest: Array = shape - shape.mean()
    if slope and len(shape) > 2:
        ramp = np.arange(len(shape)) - (len(shape) - 1) / 2.0
        rest = rest - ramp * (ramp @ rest) / (ramp @ ramp)
    return rest


def _round_taps(real: Array, *, slope: bool) -> NDArray[np.int64]:
    """Round taps to integers whose sum (and first moment) is exactly zero, shape (T,).

    The sum that rounding leaves is taken off where it comes nearest to the taps as they were.
    Symmetric taps stay symmetric, which makes their first moment zero too.

    Args:
        real: taps of sum zero (and first moment zero), shape (T,).
        slope: make the first moment zero as well.
    """
    length = len(real)
    if length % 2 == 1 and np.allclose(real, real[::-1], rtol=0.0, atol=1e-9):
        half = length // 2
        taps = np.rint(real).astype(np.int64)
        taps[half + 1 :] = taps[:half][::-1]
        pairs = int(taps.sum()) // 2
        _subtract_excess(taps[:half], real[:half], pairs)
        taps[half + 1 :] = taps[:half][::-1]
        taps[half] -= taps.sum()
        return taps
    taps = np.rint(real).astype(np.int64)
    _subtract_excess(taps, real, int(taps.sum()))
    if slope:
        _zero_first_moment(taps)
    return taps


def _subtract_excess(taps: NDArray[np.int64], real: Array, excess: int) -> None:
    """Lower (or raise) taps by one, in all ``excess``, where rounding went the other way most."""
    step = 1 if excess > 0 else -1
    for _ in range(abs(excess)):
        taps[np.argmax(step * (taps - real))] -= step


def _zero_first_moment(taps: NDArray[np.int64]) -> None:
    """Move ones between taps until the first moment is zero; the sum stays."""
    length = len(taps)
    moment = int((np.arange(length) * taps).sum())
    start = length // 3
    while moment != 0:
        lag = min(abs(moment), length - 1)
        step = 1 if moment > 0 else -1
        start = (start + 1) % (length - lag)
        taps[start] += step
        taps[start + lag] -= step
        moment -= step * lag
