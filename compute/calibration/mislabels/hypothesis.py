"""An explanation of one sensor's readings: which labels are wrong, and how they belong."""

from collections.abc import Iterable
from dataclasses import dataclass
from math import comb, log
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

WRONG_LABEL_PROBABILITY: Final = 0.03
"""That a reading is wrong, before looking: every other sensor of 19 points has one."""
EXCHANGE_PROBABILITY: Final = 0.02
"""That a sensor has an exchanged pair, any of its pairs."""
CYCLE_PROBABILITY: Final = 0.002
"""That it has three labels, or more, in each other's places."""
MISSING_LABEL_PROBABILITY: Final = 0.01
"""That a reading carries the label of another point than its own, which has none."""


@dataclass(frozen=True)
class Hypothesis:
    """Label errors of one sensor, points counted from 0.

    Args:
        wrong: readings that are none of their points'.
        cycles: the reading labelled with each point belongs to the next, the last one's to the
            first; each starts with its lowest point. An exchanged pair is a cycle of two.
        reassigned: labels (carried, own): the reading labelled with the first belongs to the second,
            which has none.
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
        """Points that any error is about."""
        return self.wrong.union(*self.cycles, *self.reassigned)

    def repair(self, readings: Array, sigma: Array) -> tuple[Array, Array]:
        """Return readings and deviations (N,) with each at its own point, NaN where wrong."""
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
        """Return the logarithm of its chance before looking, relative to no error at all.

        Args:
            seen: readings that the sensor has.
            unseen: points that it has no reading of.
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
        """Return it with one wrong reading, or one cycle, fewer."""
        if isinstance(error, tuple):
            return Hypothesis(self.wrong, self.cycles - {error}, self.reassigned)
        return Hypothesis(self.wrong - {error}, self.cycles, self.reassigned)

    def with_wrong(self, point: int) -> "Hypothesis":
        """Return it with one more wrong reading."""
        return Hypothesis(self.wrong | {point}, self.cycles, self.reassigned)

    def with_cycle(self, points: Iterable[int]) -> "Hypothesis":
        """Return it with these points in a cycle, and no longer wrong."""
        cycle = tuple(points)
        first = cycle.index(min(cycle))
        return Hypothesis(
            self.wrong - set(cycle), self.cycles | {cycle[first:] + cycle[:first]}, self.reassigned
        )

    def with_reassigned(self, carried: int, own: int) -> "Hypothesis":
        """Return it with the reading labelled ``carried`` given to ``own``."""
        return Hypothesis(self.wrong - {carried}, self.cycles, self.reassigned | {(carried, own)})


def log_exchange_prior(seen: int) -> float:
    """Return the logarithm of the chance of one exchanged pair among ``seen`` readings."""
    return log(EXCHANGE_PROBABILITY / max(comb(seen, 2), 1))
