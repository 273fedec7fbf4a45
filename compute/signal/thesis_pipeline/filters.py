"""Butterworth, FIR and median filters with delay compensation, thesis 4.2.1 and Appendix B."""

from abc import abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Final, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.fft import dct, idct
from scipy.ndimage import rank_filter
from scipy.signal import (
    butter,
    firwin,
    freqz_sos,
    lfilter,
    lfilter_zi,
    oaconvolve,
    sosfilt,
    sosfilt_zi,
)

from compute.parameter_checks import require
from compute.signal.centroid_settings import require_choice, require_integer
from compute.signal.thesis_pipeline.steps import (
    MAX_TAPS,
    Array,
    Compensation,
    ScanFilter,
    as_scans,
)

MAX_ORDER: Final = 64


class _LowPass(ScanFilter):
    """A linear filter of unit gain at zero frequency."""

    cutoff: float

    @abstractmethod
    def magnitude(self, omega: Array) -> Array:
        """Return the response without its phase at ``pi k / P``, shape (P,) [rad/px]."""

    @abstractmethod
    def _causal(self, scans: Array, *, steady: bool) -> Array:
        """Run scans through the filter; ``steady``: as if each had had its first value before."""

    def apply(self, scans: ArrayLike) -> Array:
        """Filter scans (..., P)."""
        values = as_scans(scans)
        if self.compensation == "phase":
            return self._without_phase(values)
        return self._causal(values, steady=True)

    def adjoint(self, weights: Array) -> Array:
        """Carry derivatives by filtered pixels (..., P) back to derivatives by pixels.

        Run backwards from the last pixel; what the filter would answer before the first pixel
        belongs to that, and is what is left of the whole, as the gain at zero frequency is one.
        """
        if self.compensation == "phase":
            return self._without_phase(weights)
        back = self._causal(weights[..., ::-1], steady=False)
        result = back[..., ::-1].copy()
        result[..., 0] += weights.sum(axis=-1) - back.sum(axis=-1)
        return result

    def _without_phase(self, scans: Array) -> Array:
        """Multiply the spectrum of scans (..., P) by the magnitude.

        The scan is continued at both ends by its mirror image, which makes a period of 2 P pixels
        without a step where it closes; its discrete Fourier transform is the scan's cosine
        transform of the second kind, at the angular frequencies ``pi k / P``. As a matrix the
        filter is symmetric: it is its own adjoint.
        """
        pixels = scans.shape[-1]
        response = self.magnitude(np.pi * np.arange(pixels) / pixels)
        spectrum = dct(scans, type=2, norm="ortho", axis=-1) * response
        return np.asarray(idct(spectrum, type=2, norm="ortho", axis=-1))

    def _check(self) -> None:
        require(
            0.0 < self.cutoff < 1.0,
            "lie between 0 and 1, as a fraction of half the sampling rate",
            cutoff=self.cutoff,
        )
        require_choice("compensation", self.compensation, get_args(Compensation))


@dataclass(frozen=True)
class ButterworthFilter(_LowPass):
    """A Butterworth low pass in second-order sections, thesis 4.2.1 and [B.9]-[B.13].

    With "none" and "delay" the scan runs through the filter from the left, as if it had always
    had the value of its first pixel before. With "phase" the scan's discrete cosine transform
    is multiplied by the magnitude response [B.10]: the same attenuation once, not twice as when
    a scan is filtered forwards and back, and no phase at all. The scan goes on beyond its ends
    as its mirror image.

    Args:
        order: n, 1 to 64.
        cutoff: frequency at which the power is halved, as a fraction of half the sampling rate.
        compensation: "none", "delay": positions are moved back by ``delay_px``, or "phase".

    Raises:
        InvalidParameter: a value outside its range.
    """

    order: int
    cutoff: float
    compensation: Compensation = "phase"

    def __post_init__(self) -> None:
        require_integer("order", self.order, 1, MAX_ORDER)
        self._check()

    @property
    def delay_px(self) -> float:
        """The group delay [B.12] at zero frequency [px].

        It is exactly by how much the filter moves a whole scan's centre of gravity:
        ``1 / (2 sin(pi/2n) tan(pi fc/2))``, the sum over the poles through the bilinear
        transform that maps the analogue filter to samples.
        """
        return float(0.5 / (np.sin(np.pi / (2 * self.order)) * np.tan(np.pi * self.cutoff / 2.0)))

    def response(self, omega: ArrayLike) -> NDArray[np.complex128]:
        """Return the complex response [B.9] at angular frequencies, same shape [rad/px]."""
        frequency = np.asarray(omega, dtype=np.float64)
        _, response = freqz_sos(self._sections, frequency.ravel())
        return np.asarray(response, dtype=np.complex128).reshape(frequency.shape)

    def magnitude(self, omega: Array) -> Array:
        """Return the magnitude response [B.10], same shape: the square root of 1/(1 + x^2n)."""
        ratio = np.tan(omega / 2.0) / np.tan(np.pi * self.cutoff / 2.0)
        with np.errstate(over="ignore"):
            return np.asarray(1.0 / np.hypot(1.0, ratio**self.order))

    def _causal(self, scans: Array, *, steady: bool) -> Array:
        if not steady:
            return np.asarray(sosfilt(self._sections, scans))
        start = sosfilt_zi(self._sections)
        # One state per section and scan, with the sections first.
        state = start.reshape(len(start), *(1,) * (scans.ndim - 1), 2) * scans[None, ..., :1]
        return np.asarray(sosfilt(self._sections, scans, axis=-1, zi=state)[0])

    @cached_property
    def _sections(self) -> Array:
        return np.asarray(butter(self.order, self.cutoff, output="sos"), dtype=np.float64)


@dataclass(frozen=True)
class FirFilter(_LowPass):
    """A low pass of finite impulse response with linear phase, thesis 4.2.1 and [B.1]-[B.8].

    Designed with a Hamming window, and of unit gain at zero frequency. Its delay (N - 1)/2
    [B.8] is the same at all frequencies. With "phase" the scan's discrete cosine transform is
    multiplied by the response without its linear phase: what is moved back by the delay, half a
    pixel included, is exact. (That response is real; where it is negative, deep in the stop
    band, it stays so: the changes of sign are no delay.) The scan goes on beyond its ends with
    its first value for "none" and "delay", as its mirror image for "phase".

    Args:
        taps: N, 2 to 1024. The thesis's "order n" was n + 1 points: its columns are moved by
            n/2, 2 and 5.5 px for n of 4 and 11 (Tables C.1 to C.3), not by the 1.5 and 5 that
            [B.8] has for N = n.
        cutoff: frequency at which the amplitude is halved, as a fraction of half the sampling
            rate.
        compensation: "none", "delay": positions are moved back by ``delay_px``, or "phase".

    Raises:
        InvalidParameter: a value outside its range.
    """

    taps: int
    cutoff: float
    compensation: Compensation = "phase"

    def __post_init__(self) -> None:
        require_integer("taps", self.taps, 2, MAX_TAPS)
        self._check()

    @property
    def delay_px(self) -> float:
        """The group delay [B.8] at all frequencies [px]."""
        return (self.taps - 1) / 2.0

    def amplitude(self, omega: Array) -> Array:
        """Return the response without its linear phase, same shape: real, [B.4]-[B.6]."""
        arms = np.arange(self.taps) - self.delay_px
        return np.asarray(np.cos(np.multiply.outer(omega, arms)) @ self._kernel)

    def _causal(self, scans: Array, *, steady: bool) -> Array:
        if steady:
            state = lfilter_zi(self._kernel, [1.0]) * scans[..., :1]
            return np.asarray(lfilter(self._kernel, [1.0], scans, axis=-1, zi=state)[0])
        kernel = self._kernel.reshape((1,) * (scans.ndim - 1) + (-1,))
        return np.asarray(oaconvolve(scans, kernel, axes=-1)[..., : scans.shape[-1]])

    def magnitude(self, omega: Array) -> Array:
        """Return the amplitude at the angular frequencies of a mirrored scan, shape (P,)."""
        period = 2 * len(omega)
        if self.taps > period:
            return self.amplitude(omega)
        spectrum = np.fft.rfft(self._kernel, period)[:-1]
        return np.asarray((spectrum * np.exp(1j * omega * self.delay_px)).real)

    @cached_property
    def _kernel(self) -> Array:
        return np.asarray(firwin(self.taps, self.cutoff), dtype=np.float64)


@dataclass(frozen=True)
class MedianFilter(ScanFilter):
    """The median of as many neighbouring pixels as the aperture has, thesis 4.2.1.

    An even aperture has no middle pixel: pixel k becomes the mean of the two middle values of
    the pixels ``k - n/2 .. k + n/2 - 1``, whose centre is at ``k - 1/2``. The scan moves by half
    a pixel to the right, as the columns for apertures 4 and 8 of Tables C.2 to C.4 did. Beyond
    its ends a scan goes on with its end's value.

    A median has no phase response: the compensation is "none" or "delay". A flank that only
    rises or falls stays as it is under an odd aperture; tops are flattened.

    Args:
        aperture: number of pixels, 2 to 1024; 1 changes nothing.
        compensation: "delay" moves positions back by the half pixel of even apertures.

    Raises:
        InvalidParameter: a value outside its range, or "phase".
    """

    aperture: int
    compensation: Compensation = "delay"

    def __post_init__(self) -> None:
        require_integer("aperture", self.aperture, 1, MAX_TAPS)
        require_choice("compensation", self.compensation, ("none", "delay"))

    @property
    def delay_px(self) -> float:
        """Half a pixel for an even aperture."""
        return 0.0 if self.aperture % 2 else 0.5

    @property
    def reach_px(self) -> float:
        """Half the aperture."""
        return float(self.aperture // 2)

    def apply(self, scans: ArrayLike) -> Array:
        """Filter scans (..., P)."""
        values = as_scans(scans)
        # In scans one by one SciPy keeps the window sorted as it moves on.
        rows = [self._filter_scan(scan) for scan in values.reshape(-1, values.shape[-1])]
        return np.array(rows, dtype=np.float64).reshape(values.shape)

    def _filter_scan(self, scan: Array) -> Array:
        size, half = self.aperture, self.aperture // 2
        upper = np.asarray(rank_filter(scan, half, size=size, mode="nearest"))
        if size % 2:
            return upper
        return 0.5 * (upper + np.asarray(rank_filter(scan, half - 1, size=size, mode="nearest")))

    def adjoint(self, weights: Array) -> Array:
        """Return the weights as they are, for an even aperture with the half pixel.

        Assumed, as a median is not linear: it passes noise as if it left the scan alone. That
        is so on flanks steeper than the noise; on level stretches the slow part of the noise, to
        which a centre of gravity answers, grows by up to pi/2 in variance.
        """
        if self.aperture % 2:
            return weights
        back = np.zeros_like(weights)
        back[..., :-1] = 0.5 * (weights[..., :-1] + weights[..., 1:])
        back[..., -1] = 0.5 * weights[..., -1]
        back[..., 0] += 0.5 * weights[..., 0]
        return back
