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

WRONG_LABEL_PROBABILITY: Final = 0.03
"""Prior probability that a reading is wrong: every other sensor of 19 points has one."""
EXCHANGE_PROBABILITY: Final = 0.02
"""Prior probability that a sensor has an exchanged pair."""
CYCLE_PROBABILITY: Final = 0.002
"""Prior probability that it has a cycle of three or more labels."""
MISSING_LABEL_PROBABILITY: Final = 0.01
"""Prior probability that a reading carries another point's label while its own point has none."""
LOG_TWO_PI: Final = float(np.log(2.0 * np.pi))


@dataclass(frozen=True)
class Hypothesis:
    """Label errors of one sensor, points counted from 0.

    Args:
        wrong: readings that belong to no point.
        cycles: the reading labelled with each point belongs to the next, the last one's to the
            first; each starts with its lowest point. An exchanged pair is a cycle of two.
        reassigned: labels (carried, own): the reading labelled with the first belongs to the
            second, which has none.
    """

    wrong: frozenset[int] = frozenset()
    cycles: frozenset[tuple[int, ...]] = frozenset()
    reassigned: frozenset[tuple[int, int]] = frozenset()

    @property
    def size(self) -> int:
        """Number of errors."""
        return len(self.wrong) + len(self.cycles) + len(self.reassigned)

    @property
    def affected_points(self) -> frozenset[int]:
        """Points that take part in any error."""
        return self.wrong.union(*self.cycles, *self.reassigned)

    def repair(self, readings: Array, sigma: Array) -> tuple[Array, Array]:
        """Repair readings under this hypothesis.

        Args:
            readings: of the N points, shape (N,) [px].
            sigma: their standard deviations, shape (N,) [px].

        Returns:
            Both in the order of the points, shape (N,); wrong readings are NaN.
        """
        readings, sigma = readings.copy(), sigma.copy()
        for cycle in self.cycles:
            here, there = list(cycle), [*cycle[1:], cycle[0]]
            readings[there], sigma[there] = readings[here], sigma[here]
        for carried, own in self.reassigned:
            readings[own], sigma[own] = readings[carried], sigma[carried]
            readings[carried] = np.nan
        readings[list(self.wrong)] = np.nan
        return readings, sigma

    def log_prior(self, seen: int, unseen: int) -> float:
        """Return the log prior probability relative to no error.

        Args:
            seen: number of readings of the sensor.
            unseen: number of points without one.
        """
        total = len(self.wrong) * log(WRONG_LABEL_PROBABILITY)
        for cycle in self.cycles:
            if len(cycle) == 2:
                total += log_exchange_prior(seen)
            else:
                total += log(CYCLE_PROBABILITY / (comb(seen, len(cycle)) * (len(cycle) - 1)))
        total += len(self.reassigned) * log(MISSING_LABEL_PROBABILITY / max(seen * unseen, 1))
        return total

    def without(self, error: int | tuple[int, ...]) -> "Hypothesis":
        """Return the hypothesis with one wrong reading, or one cycle, fewer."""
        if isinstance(error, tuple):
            return Hypothesis(self.wrong, self.cycles - {error}, self.reassigned)
        return Hypothesis(self.wrong - {error}, self.cycles, self.reassigned)

    def with_wrong(self, point: int) -> "Hypothesis":
        """Return the hypothesis with one more wrong reading."""
        return Hypothesis(self.wrong | {point}, self.cycles, self.reassigned)

    def with_cycle(self, points: Iterable[int]) -> "Hypothesis":
        """Return the hypothesis with these points in a cycle, and no longer wrong."""
        cycle = tuple(points)
        first = cycle.index(min(cycle))
        return Hypothesis(
            self.wrong - set(cycle), self.cycles | {cycle[first:] + cycle[:first]}, self.reassigned
        )

    def with_reassigned(self, carried: int, own: int) -> "Hypothesis":
        """Return the hypothesis with one reading assigned to another point.

        Args:
            carried: the label that the reading carries.
            own: the point that it belongs to.
        """
        return Hypothesis(self.wrong - {carried}, self.cycles, self.reassigned | {(carried, own)})


def log_exchange_prior(seen: int) -> float:
    """Return the log prior probability of one exchanged pair among ``seen`` readings."""
    return log(EXCHANGE_PROBABILITY / max(comb(seen, 2), 1))


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
    factor of the standard deviations where it is unknown: a reading that is left out costs its
    information, so that a hypothesis with more errors must fit better.

    Args:
        pixels: number of the sensor's pixels.
        scale: prior of the common factor.
        parameters: number of camera parameters.
    """

    pixels: int
    scale: ScalePrior
    parameters: int = PARAMETER_COUNT

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
