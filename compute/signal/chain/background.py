"""PolynomialBackground and BridgedBackground: ambient light between the peaks, thesis 4.4."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import binary_dilation

from compute.signal.chain.step import Array, LineFilter, as_lines, check_between, check_whole

Mask = NDArray[np.bool_]

MOST_DEGREE: Final = 30
_ROUNDING: Final = 1e-10  # of the largest value: what a fit of a polynomial leaves of itself
_NORMAL_MAD: Final = 1.4826


@dataclass(frozen=True)
class PeakMask:
    """Which pixels are peaks: those that stand out above a polynomial through the others.

    A polynomial is fitted to the line; the pixels that lie higher above it than the noise
    explains are taken out with a margin, and it is fitted again to the rest, until no pixel is
    added. The noise is 1.48 times the median absolute residual of the pixels in use.

    Args:
        degree: of the polynomial, 0 to 30.
        above_sigma: what is higher above it than this many standard deviations is a peak.
        margin_px: pixels taken out on either side of it, 0 to 1000.
        rounds: fits at most, 1 to 1000.

    Raises:
        InvalidParameter: a value outside its range.
    """

    degree: int = 5
    above_sigma: float = 3.0
    margin_px: int = 3
    rounds: int = 50

    def __post_init__(self) -> None:
        check_whole("degree", self.degree, 0, MOST_DEGREE)
        check_between("above_sigma", self.above_sigma, 1.0, 100.0)
        check_whole("margin_px", self.margin_px, 0, 1000)
        check_whole("rounds", self.rounds, 1, 1000)

    def free_of_peaks(self, line: Array) -> Mask:
        """Return which pixels of one line (P,) are no peak, shape (P,).

        At least 2 (degree + 1) pixels stay: a round that would leave fewer is the last.
        """
        basis = _basis(len(line), self.degree)
        free = np.ones(len(line), dtype=np.bool_)
        floor = _ROUNDING * float(np.abs(line).max())
        for _ in range(self.rounds):
            residual = line - basis @ _solve(basis[free], line[free])
            noise = _NORMAL_MAD * float(np.median(np.abs(residual[free])))
            peak = residual > max(self.above_sigma * noise, floor)
            # A lone pixel may be noise; it goes, but does not take its neighbours with it.
            wide = peak & (np.roll(peak, 1) | np.roll(peak, -1))
            peak |= binary_dilation(wide, iterations=self.margin_px) if self.margin_px else wide
            left = free & ~peak
            if left.sum() < 2 * (self.degree + 1) or (left == free).all():
                break
            free = left
        return free


@dataclass(frozen=True)
class PolynomialBackground:
    """A polynomial through the pixels between the peaks, by least squares: thesis 4.4.

    In Chebyshev polynomials over the line, which keeps high degrees well conditioned.

    Args:
        degree: 0 to 30; 0 is a level.
        above_sigma, margin_px, rounds: what counts as a peak: PeakMask, of the same degree.

    Raises:
        InvalidParameter: a value outside its range.
    """

    degree: int = 5
    above_sigma: float = 3.0
    margin_px: int = 3
    rounds: int = 50

    def __post_init__(self) -> None:
        self._mask()

    def estimate(self, lines: ArrayLike) -> tuple[Array, Mask]:
        """Return the background of lines (..., P), and the pixels that it was fitted to."""
        mask = self._mask()

        def one(line: Array) -> tuple[Array, Mask]:
            free = mask.free_of_peaks(line)
            basis = _basis(len(line), self.degree)
            return basis @ _solve(basis[free], line[free]), free

        return _each(as_lines(lines), one)

    def adjoint(self, weights: Array, taken: Mask) -> Array:
        """Carry derivatives by the line less its background back to its pixels, shape (P,).

        Which pixels were fitted to is taken as given.
        """
        basis = _basis(len(weights), self.degree)
        fitted = basis[taken]
        back = weights.copy()
        back[taken] -= fitted @ _solve(fitted.T @ fitted, basis.T @ weights)
        return back

    def _mask(self) -> PeakMask:
        return PeakMask(self.degree, self.above_sigma, self.margin_px, self.rounds)


@dataclass(frozen=True)
class BridgedBackground:
    """The line with its peaks cut out and the gaps bridged, filtered: Test 4.1, thesis 4.4 (1)-(2).

    "Isolating the peaks and linearizing the rest of the signal; the profile was superimposed
    over the initial signal to fill the gaps between peaks and filtered again." Read as: between
    the pixels on either side of each peak runs a straight line; elsewhere the background is the
    line itself; both together go through a filter. How the peaks are told from an uneven
    background the text does not say: here by PeakMask.

    Args:
        mask: what counts as a peak; the margin keeps the bridges off the peaks' feet.
        smoothing: the filter; None leaves it out, and between the peaks nothing is left.

    Raises:
        InvalidParameter: by the parts.
    """

    mask: PeakMask
    smoothing: LineFilter | None = None

    def estimate(self, lines: ArrayLike) -> tuple[Array, Mask]:
        """Return the background of lines (..., P), and the pixels that it was taken from."""

        def one(line: Array) -> tuple[Array, Mask]:
            free = self.mask.free_of_peaks(line)
            pixels = np.arange(len(line))
            bridged = np.interp(pixels, pixels[free], line[free])
            return (bridged if self.smoothing is None else self.smoothing.apply(bridged)), free

        return _each(as_lines(lines), one)

    def adjoint(self, weights: Array, taken: Mask) -> Array:
        """Carry derivatives by the line less its background back to its pixels, shape (P,)."""
        spread = weights if self.smoothing is None else self.smoothing.adjoint(weights)
        pixels = np.arange(len(weights))
        known = pixels[taken]
        after = np.searchsorted(known, pixels).clip(1, len(known) - 1)
        low, high = known[after - 1], known[after]
        share = ((pixels - low) / (high - low)).clip(0.0, 1.0)
        back = weights.copy()
        np.subtract.at(back, low, (1.0 - share) * spread)
        np.subtract.at(back, high, share * spread)
        return back


def _each(lines: Array, one: Callable[[Array], tuple[Array, Mask]]) -> tuple[Array, Mask]:
    rows = lines.reshape(-1, lines.shape[-1])
    background, free = np.empty_like(rows), np.empty(rows.shape, dtype=np.bool_)
    for number, row in enumerate(rows):
        background[number], free[number] = one(row)
    return background.reshape(lines.shape), free.reshape(lines.shape)


def _basis(pixels: int, degree: int) -> Array:
    """Return Chebyshev polynomials over the line, shape (P, degree + 1)."""
    return np.asarray(chebyshev.chebvander(np.linspace(-1.0, 1.0, pixels), degree))


def _solve(matrix: Array, values: Array) -> Array:
    return np.asarray(np.linalg.lstsq(matrix, values, rcond=None)[0])
