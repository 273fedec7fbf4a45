"""How well an explanation accounts for a sensor's readings: its marginal likelihood."""

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
    """What is known of the readings' deviations but for a common factor (inverse gamma).

    Args:
        dof: as many readings' worth of knowledge; infinite: the factor is known.
        factor: the factor known, or expected.
    """

    dof: float
    factor: float


KNOWN_SIGMA: Final = ScalePrior(np.inf, 1.0)


@dataclass(frozen=True)
class Evidence:
    """Marginal likelihoods of explanations of one sensor's readings.

    A reading that is right is normal about the camera's, one that is wrong lies anywhere on the
    sensor. The seven parameters are integrated out (Laplace, flat prior), and so is the common
    factor of the deviations where it is not known: leaving out a reading costs what it tells
    about the camera, and an explanation with more errors has to earn them.

    Args:
        pixels: the sensor's pixels.
        scale: what is known of the deviations.
        parameters: of the camera.
    """

    pixels: int
    scale: ScalePrior
    parameters: int = PARAMETER_COUNT_PROJECTIVE

    def log_likelihood(
        self, chi2: Array, kept: Array, log_determinant: Array, log_sigma: Array, wrong: Array
    ) -> Array:
        """Return the logarithms, shape (...), but for a constant of the sensor.

        Args:
            chi2: squares of the residuals over the stated deviations, summed over what is kept.
            kept: number of readings kept.
            log_determinant: of J'WJ over them.
            log_sigma: sum of the logarithms of their deviations [px].
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
        """Return the factor of the deviations after looking."""
        prior = self.scale.dof
        if np.isinf(prior):
            return self.scale.factor
        dof = max(kept - self.parameters, 0)
        return float(np.sqrt((prior * self.scale.factor**2 + chi2) / (prior + dof)))
