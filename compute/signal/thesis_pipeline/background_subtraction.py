"""Ambient light between the peaks: polynomial and interpolated background, thesis 4.4."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from scipy.linalg import cho_solve
from scipy.ndimage import maximum_filter1d
from scipy.sparse import csr_array

from compute.robust_statistics import MAD_TO_SIGMA
from compute.signal.centroid_settings import require_between, require_integer
from compute.signal.thesis_pipeline.steps import Array, Background, ScanFilter

Mask = NDArray[np.bool_]

MAX_DEGREE: Final = 30
_ROUNDING: Final = 1e-10  # of the largest value: what a fit of a polynomial leaves of itself
_SINGULAR: Final = 1e-11  # of an information of ones: polynomials that the pixels do not see


@dataclass(frozen=True)
class PeakMask:
    """Peak pixels: those that stand out above a polynomial through the others.

    A polynomial is fitted to the scan; the pixels that lie higher above it than the noise
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
        require_integer("degree", self.degree, 0, MAX_DEGREE)
        require_between("above_sigma", self.above_sigma, 1.0, 100.0)
        require_integer("margin_px", self.margin_px, 0, 1000)
        require_integer("rounds", self.rounds, 1, 1000)

    def background_mask(self, scan: Array) -> Mask:
        """Return which pixels of one scan (P,) are no peak, shape (P,).

        At least 2 (degree + 1) pixels stay: a round that would leave fewer is the last.
        """
        basis, across = _orthonormal(len(scan), self.degree)
        free = np.ones(len(scan), dtype=np.bool_)
        floor = _ROUNDING * float(np.abs(scan).max())
        # Pixels only ever go, and each round starts from the last one's fit: a step by the
        # information that is left, instead of a fit from the start.
        information = np.eye(self.degree + 1)
        fitted, residual = np.zeros(self.degree + 1), scan
        for _ in range(self.rounds):
            fitted = fitted + _step(information, _product(basis, np.where(free, residual, 0.0)))
            residual = scan - _product(across, fitted)
            noise = MAD_TO_SIGMA * float(np.median(np.abs(residual[free])))
            peak = residual > max(self.above_sigma * noise, floor)
            # A lone pixel may be noise; it goes, but does not take its neighbours with it.
            wide = peak & (np.roll(peak, 1) | np.roll(peak, -1))
            peak |= maximum_filter1d(wide, 2 * self.margin_px + 1, mode="constant", cval=0)
            remaining = free & ~peak
            if remaining.sum() < 2 * (self.degree + 1) or (remaining == free).all():
                break
            removed = basis[free & ~remaining]
            information = information - np.einsum("ij,ik->jk", removed, removed)
            free = remaining
        return free


@dataclass(frozen=True)
class PolynomialBackground(PeakMask, Background):
    """A polynomial through the pixels between the peaks, by least squares: thesis 4.4.

    In Chebyshev polynomials over the scan, which keeps high degrees well conditioned. What counts
    as a peak is PeakMask's, of the same degree.
    """

    def estimate_scan(self, scan: Array) -> tuple[Array, Mask]:
        """Return the polynomial of one scan (P,), and the pixels that it was fitted to."""
        free = self.background_mask(scan)
        return _fit_polynomial(scan, free, self.degree), free

    def adjoint(self, weights: Array, background_mask: Mask) -> Array:
        """Carry derivatives by a scan less its background back to its pixels, shape (..., P).

        Args:
            weights: derivatives by the scan less its background, shape (..., P).
            background_mask: pixels that the polynomial was fitted to, shape (P,).
        """
        basis = _basis(weights.shape[-1], self.degree)
        fitted = basis[background_mask]
        rows = weights.reshape(-1, weights.shape[-1])
        back = rows.copy()
        scores = np.einsum("kp,pj->jk", rows, basis)
        fits = np.linalg.lstsq(np.einsum("pi,pj->ij", fitted, fitted), scores, rcond=None)[0]
        back[:, background_mask] -= np.einsum("pj,jk->kp", fitted, fits)
        return back.reshape(weights.shape)


@dataclass(frozen=True)
class InterpolatedBackground(Background):
    """Background by cutting out peaks and bridging the gaps, filtered; thesis 4.4 (1)-(2).

    "Isolating the peaks and linearizing the rest of the signal; the profile was superimposed
    over the initial signal to fill the gaps between peaks and filtered again." Read as: between
    the pixels on either side of each peak runs a straight line; elsewhere the background is the
    scan itself; both together go through a filter. How the peaks are told from an uneven
    background the text does not say: here by PeakMask.

    Args:
        mask: what counts as a peak; the margin keeps the bridges off the peaks' feet.
        smoothing: the filter; None leaves it out, and between the peaks nothing is left.

    Raises:
        InvalidParameter: by the parts.
    """

    mask: PeakMask
    smoothing: ScanFilter | None = None

    def estimate_scan(self, scan: Array) -> tuple[Array, Mask]:
        """Return the background of one scan (P,), and the pixels that it was estimated from."""
        free = self.mask.background_mask(scan)
        pixels = np.arange(len(scan))
        bridged = np.interp(pixels, pixels[free], scan[free])
        return (bridged if self.smoothing is None else self.smoothing.apply(bridged)), free

    def adjoint(self, weights: Array, background_mask: Mask) -> Array:
        """Carry derivatives by a scan less its background back to its pixels, shape (..., P).

        Args:
            weights: derivatives by the scan less its background, shape (..., P).
            background_mask: pixels that the background was taken from, shape (P,).
        """
        smoothed = weights if self.smoothing is None else self.smoothing.adjoint(weights)
        count = weights.shape[-1]
        pixels = np.arange(count)
        background = pixels[background_mask]
        after = np.searchsorted(background, pixels).clip(1, len(background) - 1)
        low, high = background[after - 1], background[after]
        share = ((pixels - low) / (high - low)).clip(0.0, 1.0)
        ends = (np.concatenate([low, high]), np.concatenate([pixels, pixels]))
        bridges = csr_array((np.concatenate([1.0 - share, share]), ends), shape=(count, count))
        interpolated = (bridges @ smoothed.reshape(-1, count).T).T
        return np.asarray(weights - interpolated.reshape(weights.shape))


def _basis(pixels: int, degree: int) -> Array:
    """Return Chebyshev polynomials over the scan, shape (P, degree + 1)."""
    return np.asarray(chebyshev.chebvander(np.linspace(-1.0, 1.0, pixels), degree))


@lru_cache(maxsize=8)
def _orthonormal(pixels: int, degree: int) -> tuple[Array, Array]:
    """Return polynomials that are orthonormal over the pixels, (P, degree + 1), and transposed."""
    basis = np.ascontiguousarray(np.linalg.qr(_basis(pixels, degree))[0])
    across = np.ascontiguousarray(basis.T)
    for array in (basis, across):
        array.setflags(write=False)
    return basis, across


def _product(matrix: Array, vector: Array) -> Array:
    """Return ``matrix.T @ vector`` without the threads of BLAS.

    On a busy machine these wait for each other for far longer than such a product takes.
    """
    return np.asarray(np.einsum("ij,i->j", matrix, vector))


def _step(information: Array, score: Array) -> Array:
    """Return the step to the best fit; polynomials that no pixel sees stay as they are."""
    try:
        factor = np.linalg.cholesky(information)
        if float(np.diag(factor).min()) ** 2 > _SINGULAR:
            return np.asarray(cho_solve((factor, True), score, check_finite=False))
    except np.linalg.LinAlgError:
        pass
    values, vectors = np.linalg.eigh(information)
    nonsingular = values > _SINGULAR
    return np.asarray(
        vectors[:, nonsingular] @ ((vectors[:, nonsingular].T @ score) / values[nonsingular])
    )


def _fit_polynomial(scan: Array, free: Mask, degree: int) -> Array:
    """Return the polynomial that fits the free pixels of a scan (P,) best, shape (P,)."""
    basis, across = _orthonormal(len(scan), degree)
    used = basis[free]
    information = np.einsum("ij,ik->jk", used, used)
    fitted, residual = np.zeros(degree + 1), scan
    # The second step takes away what rounding left of the first.
    for _ in range(2):
        fitted = fitted + _step(information, _product(basis, np.where(free, residual, 0.0)))
        residual = scan - _product(across, fitted)
    return _product(across, fitted)
