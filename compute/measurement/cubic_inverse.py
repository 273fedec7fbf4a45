"""Inverse of the cubic distortion, thesis [5.12], to rounding."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def invert_cubic(corrected_px: Array, principal_point_px: Array, cubic_per_px2: Array) -> Array:
    """Solve ``q + D (q - p0)^3 = p`` for the raw readings q.

    Cardano's root on the branch through p0, in its trigonometric (D < 0) and hyperbolic (D > 0)
    form, then one Newton step, which removes the rounding of the functions.

    Args:
        corrected_px: corrected readings p, shape (..., S) [px].
        principal_point_px: p0, shape (S,) [px].
        cubic_per_px2: D, shape (S,) [1/px^2].

    Returns:
        Raw readings q, shape (..., S) [px]; NaN beyond the fold ``q - p0 = 1 / sqrt(-3 D)`` of a
        negative D, where no reading corrects to p.
    """
    offset = corrected_px - principal_point_px
    # t + D t^3 = w with t = 2 x / k, k = sqrt(3 |D|), is 3 x +- 4 x^3 = 1.5 k w.
    scale = np.sqrt(3.0 * np.abs(cubic_per_px2))
    plain = scale == 0.0
    argument = 1.5 * scale * offset
    with np.errstate(invalid="ignore"):
        root = np.where(
            cubic_per_px2 < 0.0,
            np.sin(np.arcsin(argument) / 3.0),
            np.sinh(np.arcsinh(argument) / 3.0),
        )
    root = np.where(plain, offset, 2.0 * root / np.where(plain, 1.0, scale))
    slope = 1.0 + 3.0 * cubic_per_px2 * root**2
    misfit = root + cubic_per_px2 * root**3 - offset
    # At the fold itself the slope is 0 and the root is exact enough.
    root = root - np.divide(misfit, slope, out=np.zeros_like(misfit), where=slope > 1e-6)
    reading: Array = principal_point_px + root
    return reading
