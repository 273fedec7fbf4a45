"""apply_magnitude: a filter without its phase, by the cosine transform of the mirrored line."""

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct, idct

Array = NDArray[np.float64]

_AXIS: Final = -1


def apply_magnitude(lines: Array, magnitude: Callable[[Array], Array]) -> Array:
    """Multiply the spectrum of lines by a real response.

    The line is continued at both ends by its mirror image, which makes a period of 2 P pixels
    without a step where it closes; its discrete Fourier transform is the line's cosine
    transform of the second kind, at the angular frequencies ``pi k / P``. A constant line is
    unchanged if the response at zero is 1. As a matrix the filter is symmetric: it is its own
    adjoint.

    Args:
        lines: shape (..., P).
        magnitude: the response at angular frequencies (P,) [rad/px], below pi.

    Returns:
        The filtered lines, shape (..., P).
    """
    pixels = lines.shape[_AXIS]
    response = magnitude(np.pi * np.arange(pixels) / pixels)
    spectrum = dct(lines, type=2, norm="ortho", axis=_AXIS) * response
    return np.asarray(idct(spectrum, type=2, norm="ortho", axis=_AXIS))
