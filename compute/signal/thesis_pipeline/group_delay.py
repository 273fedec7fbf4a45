"""The delays of filters: at zero frequency, and by the line that is fitted to the phase."""

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

_POINTS: Final = 4001


def linear_phase_slope(
    response: Callable[[NDArray[np.float64]], NDArray[np.complex128]], to_omega: float
) -> float:
    """Return the delay by a straight line through the phase, from zero to a frequency [px].

    [B.13]: the line is fitted by least squares, its intercept free; the delay is its slope,
    with the sign that makes it positive for a filter that comes late.
    """
    omega = np.linspace(0.0, to_omega, _POINTS)
    phase = np.unwrap(np.angle(response(omega)))
    centred = omega - omega.mean()
    return float(-(centred @ phase) / (centred @ centred))
