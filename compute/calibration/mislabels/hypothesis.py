"""Hypothesis: a set of label errors of one sensor, its prior and its marginal likelihood."""

from collections.abc import Iterable
from dataclasses import dataclass
from math import comb, log
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from compute.camera.model import PARAMETER_COUNT

Array = NDArray[np.float64]

EXCHANGE_PROBABILITY: Final = 0.02
"""Prior probability that a sensor has an exchanged pair."""
CYCLE_PROBABILITY: Final = 0.002
"""Prior probability that it has a cycle of three or more labels."""
WRONG_LABEL_PROBABILITY: Final = 0.01
"""Prior probability that a reading carries another point's label while its own point has none."""
GROSS_ERROR_PROBABILITY: Final = 0.03
"""Prior probability that a reading is anywhere: every other sensor of 19 points has one."""
TAIL_SIGMA: Final = 3.0
"""Error, in standard deviations of the noise's core, from which a reading may lie in the tail."""
OUTLIER_SIGMA: Final = 5.0
"""Error, in the same unit, from which a reading is called an outlier."""
TYPICAL_OUTLIER_SIGMA: Final = 6.0
"""Error of the readings that the beam search leaves out."""
TAIL_PRIOR_SHARE: Final = 1e-3
"""Expected share of readings in the tail before any was seen: little, where noise is normal."""
TAIL_PRIOR_READINGS: Final = 20.0
"""Weight of that share, in readings."""
TAIL_PRIOR_EXPONENT: Final = 2.0
"""Expected exponent of the tail: between Cauchy's distribution and Student's of 3 dof."""
TAIL_PRIOR_COUNT: Final = 3.0
"""Weight of that exponent, in readings in the tail."""
TAIL_ITERATIONS: Final = 30
PREDICTION_NODES: Final = np.linspace(-5.0, 5.0, 241)
PREDICTION_WEIGHTS: Final = (
    np.exp(-0.5 * PREDICTION_NODES**2) / np.exp(-0.5 * PREDICTION_NODES**2).sum()
)
LOG_TWO_PI: Final = float(np.log(2.0 * np.pi))


@dataclass(frozen=True)
class Hypothesis:
    """Label errors of one sensor, points counted from 0.

    Args:
        outliers: readings left out: neither the normal core of the noise nor a label explains
            them.
        cycles: the reading labelled with each point belongs to the next, the last one's to the
            first; each starts with its lowest point. An exchanged pair is a cycle of two.
        reassigned: labels (carried, own): the reading labelled with the first belongs to the
            second, which has none.
    """

    outliers: frozenset[int] = frozenset()
    cycles: frozenset[tuple[int, ...]] = frozenset()
    reassigned: frozenset[tuple[int, int]] = frozenset()

    @property
    def size(self) -> int:
        """Number of errors."""
        return len(self.outliers) + len(self.cycles) + len(self.reassigned)

    @property
    def affected_points(self) -> frozenset[int]:
        """Points that take part in any error."""
        return self.outliers.union(*self.cycles, *self.reassigned)

    def repair(self, readings: Array, sigma: Array) -> tuple[Array, Array]:
        """Repair readings under this hypothesis.

        Args:
            readings: of the N points, shape (N,) [px].
            sigma: their standard deviations, shape (N,) [px].

        Returns:
            Both in the order of the points, shape (N,); outliers are NaN.
        """
        readings, sigma = readings.copy(), sigma.copy()
        for cycle in self.cycles:
            here, there = list(cycle), [*cycle[1:], cycle[0]]
            readings[there], sigma[there] = readings[here], sigma[here]
        for carried, actual in self.reassigned:
            readings[actual], sigma[actual] = readings[carried], sigma[carried]
            readings[carried] = np.nan
        readings[list(self.outliers)] = np.nan
        return readings, sigma

    def log_prior(self, measured: int, unmeasured: int) -> float:
        """Return the log prior probability of the label errors, relative to none.

        Outliers belong to the noise: ``NoiseTail`` has their probability.

        Args:
            measured: number of readings of the sensor.
            unmeasured: number of points without one.
        """
        total = 0.0
        for cycle in self.cycles:
            if len(cycle) == 2:
                total += log_exchange_prior(measured)
            else:
                total += log(CYCLE_PROBABILITY / (comb(measured, len(cycle)) * (len(cycle) - 1)))
        total += len(self.reassigned) * log(WRONG_LABEL_PROBABILITY / max(measured * unmeasured, 1))
        return total

    def without(self, error: int | tuple[int, ...]) -> "Hypothesis":
        """Return the hypothesis with one outlier, one cycle or one wrong label fewer."""
        if isinstance(error, tuple):
            reassigned = frozenset(pair for pair in self.reassigned if pair != error)
            return Hypothesis(self.outliers, self.cycles - {error}, reassigned)
        return Hypothesis(self.outliers - {error}, self.cycles, self.reassigned)

    def with_outlier(self, point: int) -> "Hypothesis":
        """Return the hypothesis with one more outlier."""
        return Hypothesis(self.outliers | {point}, self.cycles, self.reassigned)

    def with_cycle(self, points: Iterable[int]) -> "Hypothesis":
        """Return the hypothesis with these points in a cycle, and no longer outliers."""
        cycle = tuple(points)
        first = cycle.index(min(cycle))
        cycles = self.cycles | {cycle[first:] + cycle[:first]}
        return Hypothesis(self.outliers - set(cycle), cycles, self.reassigned)

    def with_reassigned(self, carried: int, actual: int) -> "Hypothesis":
        """Return the hypothesis with one reading assigned to another point.

        Args:
            carried: the label that the reading carries.
            actual: the point that it belongs to.
        """
        reassigned = self.reassigned | {(carried, actual)}
        return Hypothesis(self.outliers - {carried}, self.cycles, reassigned)


def log_exchange_prior(measured: int) -> float:
    """Return the log prior probability of one exchanged pair among ``measured`` readings."""
    return log(EXCHANGE_PROBABILITY / max(comb(measured, 2), 1))


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
class NoiseTail:
    """Density of the errors that the normal core of the noise does not explain.

    They are gross errors anywhere on the sensor, or lie in the tail of the noise: from
    ``TAIL_SIGMA`` standard deviations of the core on, it falls off as a power of the error, as
    Student's t does. ``estimate_tail`` estimates share and exponent.

    Args:
        share: probability that an error lies in the tail.
        exponent: of the tail's distribution function; Student's t has its degrees of freedom.
    """

    share: float
    exponent: float

    def density(self, error: Array) -> Array:
        """Return the tail's share of the density of errors in standard deviations, same shape."""
        size = np.maximum(np.abs(error), TAIL_SIGMA)
        density = 0.5 * self.share * self.exponent / TAIL_SIGMA
        power = (TAIL_SIGMA / size) ** (self.exponent + 1.0)
        return np.where(np.abs(error) >= TAIL_SIGMA, density * power, 0.0)

    def log_density(
        self, error: Array, prediction_sigma: Array, sigma_px: Array, pixels: int
    ) -> tuple[Array, Array]:
        """Return log densities of outliers, and the probabilities of large errors.

        Args:
            error: outliers minus predicted readings, over their standard deviations, shape (K,).
            prediction_sigma: standard deviations of the predictions, in the same unit, shape (K,).
            sigma_px: standard deviations of the readings, shape (K,) [px].
            pixels: number of the sensor's pixels.

        Returns:
            Log densities times their probability, shape (K,) [1/px]. Probabilities that the true
            errors are gross, or ``OUTLIER_SIGMA`` or more, shape (K,).
        """
        true = error[:, None] + prediction_sigma[:, None] * PREDICTION_NODES
        tail = self.density(true) * PREDICTION_WEIGHTS / sigma_px[:, None]
        gross = GROSS_ERROR_PROBABILITY / pixels
        total = gross + tail.sum(axis=1)
        large = gross + np.where(np.abs(true) >= OUTLIER_SIGMA, tail, 0.0).sum(axis=1)
        return np.log(total), large / total


NORMAL_TAIL: Final = NoiseTail(TAIL_PRIOR_SHARE, TAIL_PRIOR_EXPONENT)
"""The tail as expected before any reading was seen."""


def estimate_tail(errors: Array, gross_density: Array) -> NoiseTail:
    """Estimate the noise's tail from errors by expectation-maximisation.

    Each error counts by its probability of lying in the tail: not in the normal core, and not
    gross. The exponent is Hill's estimate (doi:10.1214/aos/1176343247) with a prior.

    Args:
        errors: errors over their standard deviations, shape (N,).
        gross_density: density of a gross error times its probability, in the same unit, (N,).
    """
    tail, readings = NORMAL_TAIL, len(errors)
    far = np.abs(errors) >= TAIL_SIGMA
    errors, other = errors[far], gross_density[far]
    other = other + np.exp(-0.5 * (errors**2 + LOG_TWO_PI))
    logs = np.log(np.abs(errors) / TAIL_SIGMA)
    for _ in range(TAIL_ITERATIONS):
        density = tail.density(errors)
        weights = density / (density + other)
        count, total = float(weights.sum()), float(weights @ logs)
        tail = NoiseTail(
            (TAIL_PRIOR_SHARE * TAIL_PRIOR_READINGS + count) / (TAIL_PRIOR_READINGS + readings),
            (TAIL_PRIOR_COUNT + count) / (TAIL_PRIOR_COUNT / TAIL_PRIOR_EXPONENT + total),
        )
    return tail


@dataclass(frozen=True)
class Evidence:
    """Marginal likelihood of hypotheses of one sensor's readings.

    A reading is normally distributed about the camera's; outliers have the density of the noise's
    tail. The camera's parameters are integrated out (Laplace, flat prior), and so is the common
    factor of the standard deviations where it is unknown: a reading that is left out costs its
    information, so that a hypothesis with more errors must fit better.

    Args:
        log_outlier: log density of a typical outlier, times its probability [1/px].
        scale: prior of the common factor.
        parameters: number of camera parameters.
    """

    log_outlier: float
    scale: ScalePrior
    parameters: int = PARAMETER_COUNT

    def log_likelihood(
        self,
        chi2: Array,
        count: Array,
        log_determinant: Array,
        log_sigma: Array,
        log_outliers: Array,
    ) -> Array:
        """Return the log likelihoods up to a constant of the sensor, shape (...).

        Args:
            chi2: sum of squared residuals over the given standard deviations, of the readings kept.
            count: number of readings kept.
            log_determinant: of J'WJ over them.
            log_sigma: sum of the logarithms of their standard deviations [px].
            log_outliers: sum of the log densities of the outliers.
        """
        dof = count - self.parameters
        common = -0.5 * log_determinant - log_sigma + log_outliers
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

    def factor(self, chi2: float, count: int) -> float:
        """Return the posterior estimate of the common factor.

        Args:
            chi2: sum of squared residuals over the given standard deviations.
            count: number of readings.
        """
        prior = self.scale.dof
        if np.isinf(prior):
            return self.scale.factor
        dof = max(count - self.parameters, 0)
        return float(np.sqrt((prior * self.scale.factor**2 + chi2) / (prior + dof)))
