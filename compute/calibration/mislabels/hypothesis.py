"""Hypothesis: a set of label errors of one sensor, with its prior probability."""

from collections.abc import Iterable
from dataclasses import dataclass
from math import comb, log
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

WRONG_LABEL_PROBABILITY: Final = 0.03
"""Prior probability that a reading is wrong: every other sensor of 19 points has one."""
EXCHANGE_PROBABILITY: Final = 0.02
"""Prior probability that a sensor has an exchanged pair."""
CYCLE_PROBABILITY: Final = 0.002
"""Prior probability that it has a cycle of three or more labels."""
MISSING_LABEL_PROBABILITY: Final = 0.01
"""Prior probability that a reading carries another point's label while its own point has none."""


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
