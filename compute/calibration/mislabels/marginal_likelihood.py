"""Marginal likelihood of a label-error hypothesis of one sensor."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from compute.calibration.single_sensor.projective_camera import PARAMETER_COUNT_PROJECTIVE

Array = NDArray[np.float64]

LOG_TWO_PI: Final = float(np.log(2.0 * np.pi))


@dataclass(frozen=True)
class ScalePrior:
    """Inverse-gamma prior of a common factor of the readings' standard deviations.

    Args:
        dof: strength of the prior, as a number of readings; infinite: the factor is known.
        factor: the known, or expected, factor.
    """

    dof: float
    factor: float


KNOWN_SIGMA: Final = ScalePrior(np.inf, 1.0)


@dataclass(frozen=True)
class Evidence:
    """Marginal likelihood of hypotheses of one sensor's readings.

    A right reading is normally distributed about the camera's, a wrong one uniformly over the
    sensor. The camera's parameters are integrated out (Laplace, flat prior), and so is the common
    factor of the
    standard deviations where it is unknown: a reading that is left out costs its information, so
        that a
    hypothesis with more errors must fit better.

    Args:
        pixels: number of the sensor's pixels.
        scale: prior of the common factor.
        parameters: number of camera parameters.
    """

    pixels: int
    scale: ScalePrior
    parameters: int = PARAMETER_COUNT_PROJECTIVE

    def log_likelihood(
        self, chi2: Array, kept: Array, log_determinant: Array, log_sigma: Array, wrong: Array
    ) -> Array:
        """Return the log likelihoods up to a constant of the sensor, shape (...).

        Args:
            chi2: sum of squared residuals over the given standard deviations, of the readings kept.
            kept: number of readings kept.
            log_determinant: of J'WJ over them.
            log_sigma: sum of the logarithms of their standard deviations [px].
            wrong: number of readings left out.
        """
        dof = kept - self.parameters
        common = -0.5 * log_determinant - log_sigma - wrong * np.log(self.pixels)
        common = common - 0.5 * dof * LOG_TWO_PI
        prior = self.scale.dof
        if np.isinf(prior):
            factor = self.scale.factor
            return np.asarray(common - 0.5 * chi2 / factor**2 - dof * np.log(factor))
        shape, rate = 0.5 * prior, 0.5 * prior * self.scale.factor**2
        return np.asarray(
            common
            + shape * np.log(rate)
            - gammaln(shape)
            + gammaln(shape + 0.5 * dof)
            - (shape + 0.5 * dof) * np.log(rate + 0.5 * chi2)
        )

    def factor(self, chi2: float, kept: int) -> float:
        """Return the posterior estimate of the common factor.

        Args:
            chi2: sum of squared residuals over the given standard deviations.
            kept: number of readings.
        """
        prior = self.scale.dof
        if np.isinf(prior):
            return self.scale.factor
        dof = max(kept - self.parameters, 0)
        return float(np.sqrt((prior * self.scale.factor**2 + chi2) / (prior + dof)))
