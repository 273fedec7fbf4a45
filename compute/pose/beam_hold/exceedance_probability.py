"""The chance that an uncertain vector is longer than a limit."""

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
"""Deviations beyond which there is no doubt: 1e-14."""


def norm_exceedance_probability(mean: Array, covariance: Array | None, limit: float) -> float:
    """Return P(|x| > limit) of a normal x in space.

    Integrated along the axis of the largest variance in closed form, along the other two by
    Gauss and Hermite: to 0.02 where the deviations are as large as the limit, far better where
    they are smaller.

    Args:
        mean: shape (3,).
        covariance: shape (3, 3); None: x is known.
        limit: in the mean's unit.
    """
    length = math.hypot(*mean.tolist())
    if covariance is None:
        return float(length > limit)
    # No direction is less certain than all together: that is asked first, it costs far less. A
    # vector of little length may be long by its deviations in all three directions.
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
    """Return P(|x| > limit) of a normal number x."""
    if not variance > 0.0:
        return float(abs(mean) > limit)
    sigma = math.sqrt(variance)
    if abs(mean) + _CERTAIN_SIGMAS * sigma < limit:
        return 0.0
    return float(ndtr((mean - limit) / sigma) + ndtr((-mean - limit) / sigma))
