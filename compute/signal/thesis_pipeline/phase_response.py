"""Delay of a filter by its phase response, and filtering without the phase."""

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct, idct

Array = NDArray[np.float64]

_AXIS: Final = -1


def apply_magnitude(scans: Array, magnitude: Callable[[Array], Array]) -> Array:
    """Multiply the spectrum of scans by a real response.

    The scan is continued at both ends by its mirror image, which makes a period of 2 P pixels
    without a step where it closes; its discrete Fourier transform is the scan's cosine
    transform of the second kind, at the angular frequencies ``pi k / P``. A constant scan is
    unchanged if the response at zero is 1. As a matrix the filter is symmetric: it is its own
    adjoint.

    Args:
        scans: shape (..., P).
        magnitude: the response at angular frequencies (P,) [rad/px], below pi.

    Returns:
        The filtered scans, shape (..., P).
    """
    pixels = scans.shape[_AXIS]
    response = magnitude(np.pi * np.arange(pixels) / pixels)
    spectrum = dct(scans, type=2, norm="ortho", axis=_AXIS) * response
    return np.asarray(idct(spectrum, type=2, norm="ortho", axis=_AXIS))


_POINTS: Final = 4001


def linear_phase_slope(
    response: Callable[[NDArray[np.float64]], NDArray[np.complex128]], to_omega: float
) -> float:
    """Return the delay by a straight line through the phase, from zero to a frequency [px].

    [B.13]: the line is fitted by least squares, its intercept free; the delay is its slope,
    with the sign that makes it positive for a filter that comes late.

    Args:
        response: complex response at angular frequencies [rad/px].
        to_omega: highest angular frequency of the fit [rad/px].
    """
    omega = np.linspace(0.0, to_omega, _POINTS)
    phase = np.unwrap(np.angle(response(omega)))
    centred = omega - omega.mean()
    return float(-(centred @ phase) / (centred @ centred))
