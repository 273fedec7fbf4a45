"""Butterworth and FIR low-pass filters with delay compensation, thesis 4.2.1 and Appendix B."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
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

from compute.signal.thesis_pipeline.phase_response import apply_magnitude, linear_phase_slope
from compute.signal.thesis_pipeline.steps import (
    MAX_TAPS,
    Compensation,
    as_scans,
    check_compensation,
    check_cutoff,
    check_whole,
)

Array = NDArray[np.float64]

MAX_ORDER: Final = 64


@dataclass(frozen=True)
class ButterworthFilter:
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
        check_whole("order", self.order, 1, MAX_ORDER)
        check_cutoff(self.cutoff)
        check_compensation(self.compensation)

    @property
    def delay_px(self) -> float:
        """The group delay [B.12] at zero frequency [px].

        It is exactly by how much the filter moves a whole scan's centre of gravity:
        ``1 / (2 sin(pi/2n) tan(pi fc/2))``, the sum over the poles through the bilinear
        transform that maps the analogue filter to samples.
        """
        return float(0.5 / (np.sin(np.pi / (2 * self.order)) * np.tan(np.pi * self.cutoff / 2.0)))

    @property
    def linearised_delay_px(self) -> float:
        """Delay by the slope of the phase over the pass band, as the thesis takes it [px].

        [B.13], section 4.2.2 and Figure 4.10; the scan is fitted by least squares from zero to
        the cut-off. It is no scan's shift: the light is at low frequencies.
        """
        return linear_phase_slope(self.response, np.pi * self.cutoff)

    @property
    def shift_px(self) -> float:
        """By how much the filtered scan lies to the right [px]."""
        return 0.0 if self.compensation == "phase" else self.delay_px

    @property
    def correction_px(self) -> float:
        """What is subtracted from positions [px]."""
        return self.delay_px if self.compensation == "delay" else 0.0

    @property
    def reach_px(self) -> float:
        """How near to an end what lies beyond it weighs in [px]: the delay that it has or had."""
        return self.delay_px

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

    def apply(self, scans: ArrayLike) -> Array:
        """Filter scans (..., P)."""
        values = as_scans(scans)
        if self.compensation == "phase":
            return apply_magnitude(values, self.magnitude)
        start = sosfilt_zi(self._sections)
        # One state per section and scan, with the sections first.
        state = start.reshape(len(start), *(1,) * (values.ndim - 1), 2) * values[None, ..., :1]
        filtered, _ = sosfilt(self._sections, values, axis=-1, zi=state)
        return np.asarray(filtered)

    def adjoint(self, weights: Array) -> Array:
        """Carry derivatives by filtered pixels (..., P) back to derivatives by pixels."""
        if self.compensation == "phase":
            return apply_magnitude(weights, self.magnitude)
        return _anticausal(weights, lambda back: np.asarray(sosfilt(self._sections, back)))

    @cached_property
    def _sections(self) -> Array:
        return np.asarray(butter(self.order, self.cutoff, output="sos"), dtype=np.float64)


@dataclass(frozen=True)
class FirFilter:
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
            [B.8] has for N = n. ``of_order`` makes these.
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
        check_whole("taps", self.taps, 2, MAX_TAPS)
        check_cutoff(self.cutoff)
        check_compensation(self.compensation)

    @classmethod
    def of_order(
        cls, order: int, cutoff: float, compensation: Compensation = "phase"
    ) -> "FirFilter":
        """Make the filter of a polynomial of this order in 1/z, which has one tap more.

        Args:
            order: order of the polynomial.
            cutoff: as of the class.
            compensation: as of the class.
        """
        return cls(order + 1, cutoff, compensation)

    @property
    def delay_px(self) -> float:
        """The group delay [B.8] at all frequencies [px]."""
        return (self.taps - 1) / 2.0

    @property
    def linearised_delay_px(self) -> float:
        """Delay by the slope of the phase over the pass band [px]: the group delay."""
        return self.delay_px

    @property
    def shift_px(self) -> float:
        """By how much the filtered scan lies to the right [px]."""
        return 0.0 if self.compensation == "phase" else self.delay_px

    @property
    def correction_px(self) -> float:
        """What is subtracted from positions [px]."""
        return self.delay_px if self.compensation == "delay" else 0.0

    @property
    def reach_px(self) -> float:
        """How near to an end what lies beyond it weighs in [px]: the delay that it has or had."""
        return self.delay_px

    def response(self, omega: ArrayLike) -> NDArray[np.complex128]:
        """Return the complex response [B.1] at angular frequencies, same shape [rad/px]."""
        frequency = np.asarray(omega, dtype=np.float64)
        return np.asarray(self.amplitude(frequency) * np.exp(-1j * frequency * self.delay_px))

    def amplitude(self, omega: Array) -> Array:
        """Return the response without its linear phase, same shape: real, [B.4]-[B.6]."""
        arms = np.arange(self.taps) - self.delay_px
        return np.asarray(np.cos(np.multiply.outer(omega, arms)) @ self._kernel)

    def apply(self, scans: ArrayLike) -> Array:
        """Filter scans (..., P)."""
        values = as_scans(scans)
        if self.compensation == "phase":
            return apply_magnitude(values, self._response_of_mirrored)
        state = lfilter_zi(self._kernel, [1.0]) * values[..., :1]
        filtered, _ = lfilter(self._kernel, [1.0], values, axis=-1, zi=state)
        return np.asarray(filtered)

    def adjoint(self, weights: Array) -> Array:
        """Carry derivatives by filtered pixels (..., P) back to derivatives by pixels."""
        if self.compensation == "phase":
            return apply_magnitude(weights, self._response_of_mirrored)
        kernel = self._kernel.reshape((1,) * (weights.ndim - 1) + (-1,))
        pixels = weights.shape[-1]
        return _anticausal(
            weights, lambda back: np.asarray(oaconvolve(back, kernel, axes=-1)[..., :pixels])
        )

    def _response_of_mirrored(self, omega: Array) -> Array:
        """Return the amplitude at the angular frequencies of a mirrored scan, shape (P,)."""
        period = 2 * len(omega)
        if self.taps > period:
            return self.amplitude(omega)
        spectrum = np.fft.rfft(self._kernel, period)[:-1]
        return np.asarray((spectrum * np.exp(1j * omega * self.delay_px)).real)

    @cached_property
    def _kernel(self) -> Array:
        return np.asarray(firwin(self.taps, self.cutoff), dtype=np.float64)


def _anticausal(weights: Array, causal: Callable[[Array], Array]) -> Array:
    """Apply the transpose of a causal filter that started from the first pixel's value.

    Run backwards from the last pixel; what it would answer before the first pixel belongs to
    that, and is what is left of the whole, as the filter's gain at zero frequency is one.
    """
    back = causal(weights[..., ::-1])
    result = back[..., ::-1].copy()
    result[..., 0] += weights.sum(axis=-1) - back.sum(axis=-1)
    return result
