"""The Cramer-Rao bound of the shift of a known pattern."""

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter

Array = NDArray[np.float64]


def shift_bound_px(
    electrons: Array, derivative_electrons_per_px: Array, read_noise_electrons: float
) -> Array:
    """Return the least standard deviation of an unbiased shift of a pattern, shape (...) [px].

    ``I = sum (d mu / d x)^2 / (mu + read^2)`` over the pixels, with the pattern and its
    brightness known; the Gaussian limit of photon noise. Infinite where nothing changes.

    This is for ``mu`` known altogether, as beside a correlation, whose peak does not depend on
    the brightness. ``compute.planning.cramer_rao.position_bound`` takes the brightness as
    unknown too, which a reading of a marker must, and is never below this one; they agree where
    the derivatives by position and brightness are orthogonal, as for a symmetric line.

    Args:
        electrons: mean electrons mu of the pixels, ambient light included, shape (..., P).
        derivative_electrons_per_px: their change with the shift, from the optics (two points a
            little apart), not from differences of pixels; same shape.
        read_noise_electrons: standard deviation of the read noise, with that of the conversion.

    Raises:
        InvalidParameter: noise or electrons negative or not finite.
    """
    if not 0.0 <= read_noise_electrons < np.inf:
        raise InvalidParameter(
            f"read_noise_electrons is {read_noise_electrons}; it must be zero or positive",
            read_noise_electrons=read_noise_electrons,
        )
    lowest = float(np.min(electrons, initial=np.inf))
    if not lowest >= 0.0:
        raise InvalidParameter(
            f"electrons has {lowest}; it must be zero or positive", electrons=lowest
        )
    variance = electrons + read_noise_electrons**2
    with np.errstate(divide="ignore", invalid="ignore"):
        # A pixel without light and noise does not change either: it tells nothing.
        information = np.where(
            derivative_electrons_per_px != 0.0, derivative_electrons_per_px**2 / variance, 0.0
        ).sum(axis=-1)
        return np.asarray(1.0 / np.sqrt(information))
