"""Pairs of tracks over the last scans, with their swap probability."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from validation.thesis_tracking.intervals import PositionInterval
from validation.thesis_tracking.track_swap import (
    Density,
    Transition,
    swap_probability,
    transition,
)


@dataclass(frozen=True)
class PairState:
    """A pair of tracks in one scan.

    Args:
        probability: to exchange their targets [6.9].
        together: whether it reaches the threshold: the two are on the same track.
        transition: what this scan and the two before it say.
        side: on which side of the first the second was when they were last apart: 1, -1, or 0
            if they never were.
    """

    probability: float
    together: bool
    transition: Transition
    side: float


class TrackPairs:
    """The last three probabilities of every pair of tracks whose intervals meet.

    Args:
        threshold: of [6.9].
        density: of [6.9].
    """

    def __init__(self, threshold: float, density: Density) -> None:
        self._threshold = threshold
        self._density = density
        self._history: dict[tuple[int, int], tuple[float, ...]] = {}
        self._side: dict[tuple[int, int], float] = {}
        self._centre: dict[int, float] = {}

    def step(self, intervals: Mapping[int, PositionInterval]) -> dict[tuple[int, int], PairState]:
        """Return the states of the pairs that meet, or have met in the last two scans.

        Args:
            intervals: where each track's target may be in this scan, by the track's number. A
                track that is not among them is forgotten.
        """
        states: dict[tuple[int, int], PairState] = {}
        history: dict[tuple[int, int], tuple[float, ...]] = {}
        sides: dict[tuple[int, int], float] = {}
        numbers = sorted(intervals)
        for index, first in enumerate(numbers):
            for second in numbers[index + 1 :]:
                key, one, other = (first, second), intervals[first], intervals[second]
                apart = other.centre_px - one.centre_px
                meet = abs(apart) < one.half_width_px + other.half_width_px
                before = self._history.get(key, ())
                if not meet and not any(before):
                    continue
                # Intervals that do not meet have less than two in a hundred.
                p = swap_probability(one, other, self._density) if meet else 0.0
                history[key] = (*before[-2:], p)
                together = p >= self._threshold
                side = self._side.get(key, self._last_side(*key))
                sides[key] = side if together else float(np.sign(apart))
                states[key] = PairState(
                    p, together, transition(history[key], self._threshold), side
                )
        self._history, self._side = history, sides
        self._centre = {number: one.centre_px for number, one in intervals.items()}
        return states

    def _last_side(self, first: int, second: int) -> float:
        """Return the side of a pair that did not meet in the scan before."""
        if first not in self._centre or second not in self._centre:
            return 0.0
        return float(np.sign(self._centre[second] - self._centre[first]))
