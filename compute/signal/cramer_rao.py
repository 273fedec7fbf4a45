"""Cramer-Rao bounds: the lowest standard deviation of unbiased positions of peaks."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from compute.parameter_checks import require

Array = NDArray[np.float64]


def fisher_information(derivatives: Sequence[Array], variance: Array) -> Array:
    """Return the Fisher information of parameters from pixels with independent Gaussian noise.

    ``I_ab = sum_i (dmu_i / da) (dmu_i / db) / V_i`` (S. M. Kay, Fundamentals of Statistical Signal
    Processing I, 1993, section 3.9). The variances are taken as known: their own dependence on
    the parameters, of order 1 / electrons, is left out. A pixel without light and noise carries
    no information.

    Args:
        derivatives: of the pixels' means by each of Q parameters, each of shape (..., W).
        variance: of the pixels, shape (..., W), in the square of the means' unit.

    Returns:
        Shape (..., Q, Q).
    """
    size = len(derivatives)
    information = np.empty((*np.shape(variance)[:-1], size, size))
    with np.errstate(divide="ignore", invalid="ignore"):
        for row in range(size):
            for column in range(row, size):
                product = derivatives[row] * derivatives[column]
                terms = np.where(product != 0.0, product / variance, 0.0)
                information[..., row, column] = terms.sum(axis=-1)
                information[..., column, row] = information[..., row, column]
    return information


def position_bound(
    mean_electrons: Array,
    derivative_electrons_per_px: Array,
    noise_variance_electrons2: float,
    *,
    known_brightness: bool = False,
) -> Array:
    """Return the Cramer-Rao bound of the position of one peak or pattern of any shape.

    With the information A of the position, C of the relative brightness and B of both together,
    ``1 / bound^2 = A - B^2 / C`` (S. M. Kay, 1993, section 3.7), or A where the brightness is
    known, as beside a correlation, whose maximum does not depend on the brightness. B is zero for
    a symmetric peak.

    The bound holds the noise only. An error that is the same in every exposure, such as
    distortion, a shape that depends on the position, or an estimator's error within a pixel, is
    not in it.

    Args:
        mean_electrons: signal of each pixel of the window, shape (..., W).
        derivative_electrons_per_px: its derivative by the position, shape (..., W), from the
            optics (two points a little apart), not from differences of pixels.
        noise_variance_electrons2: variance of a pixel without signal, by ambient light, read
            noise and conversion [electrons^2].
        known_brightness: the brightness is not a parameter.

    Returns:
        Standard deviation, shape (...) [px]; infinite where there is no light.

    Raises:
        InvalidParameter: a noise variance that is negative or not finite.
    """
    require(
        0.0 <= noise_variance_electrons2 < np.inf,
        "be zero or positive",
        noise_variance_electrons2=noise_variance_electrons2,
    )
    variance = np.maximum(mean_electrons, 0.0) + noise_variance_electrons2
    joint = fisher_information((derivative_electrons_per_px, mean_electrons), variance)
    position, mixed, brightness = joint[..., 0, 0], joint[..., 0, 1], joint[..., 1, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        lost = np.where(brightness > 0.0, mixed**2 / brightness, 0.0)
        information = position if known_brightness else position - lost
        bound: Array = np.where(information > 0.0, information, 0.0) ** -0.5
    return bound
