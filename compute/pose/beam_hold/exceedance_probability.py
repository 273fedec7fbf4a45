"""Probability that an uncertain vector is longer than a limit."""

import math
from typing import Final

import numpy as np
from numpy.polynomial.hermite_e import hermegauss
from numpy.typing import NDArray
from scipy.special import ndtr

Array = NDArray[np.float64]

_NODES: Final = 32
_ABSCISSAE, _WEIGHTS = hermegauss(_NODES)
_PRODUCT_WEIGHTS: Final = np.outer(_WEIGHTS, _WEIGHTS) / _WEIGHTS.sum() ** 2
_CERTAIN_SIGMAS: Final = 8.0
"""Number of standard deviations beyond which a limit is certainly (1e-14) kept or exceeded."""


def norm_exceedance_probability(mean: Array, covariance: Array | None, limit: float) -> float:
    """Return P(|x| > limit) of a normally distributed 3-vector x.

    Integrated in closed form along the axis of the largest variance, and by Gauss-Hermite
    quadrature along the other two: to 0.02 where the standard deviations are as large as the limit,
    far better where they are smaller.

    Args:
        mean: shape (3,).
        covariance: shape (3, 3); None: x is exact.
        limit: the limit, in the unit of the mean.
    """
    length = math.hypot(*mean.tolist())
    if covariance is None:
        return float(length > limit)
    # The trace bounds the largest variance and is much cheaper than the eigenvalues: it is checked
    # first. A short mean may be exceeded by deviations in all three directions together.
    reach = _CERTAIN_SIGMAS * math.sqrt(max(float(covariance.trace()), 0.0)) + 1e-12 * limit
    if length + reach < limit:
        return 0.0
    if length - reach > limit:
        return 1.0
    values, axes = np.linalg.eigh(covariance)
    sigma = np.sqrt(np.maximum(values, 0.0))
    if length - limit > _CERTAIN_SIGMAS * sigma[2] + 1e-12 * limit:
        return 1.0
    if not sigma[2] > 0.0:
        return float(length > limit)
    along = axes.T @ mean
    first = (along[0] + sigma[0] * _ABSCISSAE)[:, None]
    second = along[1] + sigma[1] * _ABSCISSAE
    square = limit**2 - first**2 - second**2
    half = np.sqrt(np.maximum(square, 0.0))
    inside = ndtr((half - along[2]) / sigma[2]) - ndtr((-half - along[2]) / sigma[2])
    return float(np.clip(1.0 - (_PRODUCT_WEIGHTS * inside).sum(), 0.0, 1.0))


def scalar_exceedance_probability(mean: float, variance: float, limit: float) -> float:
    """Return P(|x| > limit) of a normally distributed number x.

    Args:
        mean: mean of x.
        variance: its variance, 0 where x is exact.
        limit: the limit, in the unit of the mean.
    """
    if not variance > 0.0:
        return float(abs(mean) > limit)
    sigma = math.sqrt(variance)
    if abs(mean) + _CERTAIN_SIGMAS * sigma < limit:
        return 0.0
    return float(ndtr((mean - limit) / sigma) + ndtr((-mean - limit) / sigma))
