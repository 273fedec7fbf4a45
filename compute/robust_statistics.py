"""M-estimation: Tukey's biweight, and the scale of residuals.

Huber's weights would leave a wrong reading of an outer point, which has much leverage, its
influence. The biweight redescends: from a start that outliers did not affect, they get no weight.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BIWEIGHT_LIMIT: Final = 6.0
"""Residual, in standard deviations, beyond which a reading counts for nothing."""
EFFICIENCY_LOSS: Final = 1.01934
"""E[psi^2] / E[psi']^2 for Gaussian noise and this limit: the variance beside least squares'."""
MAD_OF_NORMAL: Final = 0.6745
"""Median of the absolute value of a standard normal deviate."""
MAD_TO_SIGMA: Final = 1.4826
"""Standard deviation over that median, rounded on its own."""


def biweight(standardised: Array) -> Array:
    """Return Tukey's weights (1 - (z / BIWEIGHT_LIMIT)^2)^2, 0 beyond, of z's shape.

    A. E. Beaton, J. W. Tukey, Technometrics 16 (1974) 147-185,
    doi:10.1080/00401706.1974.10489171.
    """
    weights: Array = np.maximum(1.0 - (standardised / BIWEIGHT_LIMIT) ** 2, 0.0) ** 2
    return weights


def biweight_loss(standardised: Array) -> Array:
    """Return Tukey's loss, z^2 / 2 near 0 and BIWEIGHT_LIMIT^2 / 6 beyond the limit, of z's shape.

    ``biweight`` are the weights of its minimisation.
    """
    inside = np.maximum(1.0 - (standardised / BIWEIGHT_LIMIT) ** 2, 0.0)
    loss: Array = BIWEIGHT_LIMIT**2 / 6.0 * (1.0 - inside**3)
    return loss


def mad_sigma(residuals: Array, used: NDArray[np.bool_], parameters: int) -> Array:
    """Estimate each sensor's noise from the median of its absolute residuals, shape (S,).

    Args:
        residuals: shape (N, S).
        used: which of them exist, shape (N, S).
        parameters: number fitted for a sensor; the fit makes as many residuals small.
    """
    scales = []
    for column, rows in zip(residuals.T, used.T, strict=True):
        size = np.sort(np.abs(column[rows]))
        # As many residuals as parameters may vanish: the median of the others.
        others = size[min(parameters, len(size) - 1) :]
        scales.append(float(np.median(others)) / MAD_OF_NORMAL)
    return np.array(scales)
