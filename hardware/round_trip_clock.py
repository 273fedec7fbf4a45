"""RoundTripClock: offset of another host's clock, from round trips; its uncertainty.

A message takes time on its way there and on its way back, and no clock tells how much of it on
which. But neither way takes less than nothing: each message that came bounds the offset from one
side. Both bounds are the lines of ``hardware.clock_sync``, below the earliest arrivals of each
quarter of a second; the offset lies between them, and in the middle where both ways are as fast at
their fastest, as NTP assumes (D. L. Mills, RFC 5905; minimum delay filter).

Needed where the hosts' own clocks are not synchronised by PTP or NTP.
"""

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from compute.errors import InvalidParameter
from hardware.clock_sync import (
    BUCKET_NS,
    BUCKETS,
    DECAY_NS,
    MIN_UNCERTAINTY_NS,
    RATE_PRIOR,
    fit_lower_edge,
)

MAX_AGE_NS: Final = 10 * DECAY_NS
"""Trips before that are forgotten."""
RATE_SIGMA: Final = 2.0
"""How many of its standard deviations the rate may be off, for the bounds."""
MIN_DRIFT: Final = 1e-7
"""A rate changes by that within a minute, with the temperature."""


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """What another clock is ahead of this one, at one time.

    Args:
        offset_ns: time of the other clock less that of this one [ns].
        uncertainty_ns: standard deviation of that [ns].
        bound_ns: largest error of it that the trips leave possible, as far as the rate is known
            [ns].
        rate: length of one of the other clock's seconds on this one, less one.
    """

    offset_ns: int
    uncertainty_ns: float
    bound_ns: float
    rate: float


class RoundTripClock:
    """Estimates the offset of another clock, and its drift, from round trips.

    It has no clock and knows nothing of what carries the messages: times are given, all in whole
    nanoseconds. A clock that was set shows as trips that contradict one another; then it begins
    anew.
    """

    def __init__(self) -> None:
        self._begin()
        self.restarts = 0
        """How often a clock was set."""

    def _begin(self) -> None:
        self._origin_ns: int | None = None
        self._base_ns = 0
        # Of each quarter of a second the fastest way there and back: time, and excess.
        self._there: deque[tuple[int, int]] = deque(maxlen=BUCKETS)
        self._back: deque[tuple[int, int]] = deque(maxlen=BUCKETS)

    def add(self, sent_ns: int, received_ns: int, answered_ns: int, returned_ns: int) -> None:
        """Take a round trip.

        Args:
            sent_ns: when it was sent, on this clock.
            received_ns: when the other host received it, on the other clock.
            answered_ns: when that host sent the answer, on the other clock.
            returned_ns: when the answer came, on this clock.

        Raises:
            InvalidParameter: it came back before it was sent, or was answered before it came.
        """
        if returned_ns < sent_ns or answered_ns < received_ns:
            raise InvalidParameter(
                f"sent at {sent_ns}, returned at {returned_ns}; received at {received_ns}, "
                f"answered at {answered_ns}: each clock must go on between both of its times"
            )
        if self._origin_ns is None:
            self._origin_ns, self._base_ns = sent_ns, received_ns - sent_ns
        # The other clock less this one is at most that of the way there, at least that of the way
        # back; beyond that of the first, for small numbers.
        there = received_ns - sent_ns - self._base_ns
        back = returned_ns - answered_ns + self._base_ns
        trips = (
            (self._there, self._back, sent_ns - self._origin_ns, there),
            (self._back, self._there, returned_ns - self._origin_ns, back),
        )
        if any(_contradicts(other, at, beyond) for _, other, at, beyond in trips):
            self._begin()
            self.restarts += 1
            self.add(sent_ns, received_ns, answered_ns, returned_ns)
            return
        for ways, _, at, beyond in trips:
            _keep_fastest(ways, at, beyond)

    def offset(self, at_ns: int) -> ClockOffset | None:
        """Return the offset at a time of this clock [ns]; None: there was no trip yet."""
        if self._origin_ns is None:
            return None
        at = at_ns - self._origin_ns
        there, back = (fit_lower_edge(list(ways), 0.0, 0.0) for ways in (self._there, self._back))
        # Both lines have the same slope but for noise: the clocks' rate.
        weights = [1.0 / max(edge.rate_sigma, 1e-12) ** 2 for edge in (there, back)]
        slope = (weights[0] * there.rate - weights[1] * back.rate) / sum(weights)
        rate_sigma = min(RATE_PRIOR, 1.0 / math.sqrt(sum(weights)))
        drift = RATE_SIGMA * rate_sigma + MIN_DRIFT
        # Each trip bounds the offset of its own time; by now that may have drifted.
        upper = min(y + slope * (at - x) + drift * abs(at - x) for x, y in self._there)
        lower = max(-y + slope * (at - x) - drift * abs(at - x) for x, y in self._back)
        bound = 0.5 * max(upper - lower, 0.0)
        # Evenly likely between both.
        uncertainty = max(bound / math.sqrt(3.0), MIN_UNCERTAINTY_NS)
        offset = self._base_ns + round(0.5 * (upper + lower))
        return ClockOffset(offset, uncertainty, bound, -slope / (1.0 + slope))


def _keep_fastest(ways: deque[tuple[int, int]], at: int, beyond: int) -> None:
    """Keep the fastest way of each quarter of a second; those that are overtaken do not count."""
    if not ways or at // BUCKET_NS > ways[-1][0] // BUCKET_NS:
        ways.append((at, beyond))
    elif at >= ways[-1][0] and beyond < ways[-1][1]:
        ways[-1] = at, beyond
    while at - ways[0][0] > MAX_AGE_NS:
        ways.popleft()


def _contradicts(other: Iterable[tuple[int, int]], at: int, beyond: int) -> bool:
    """Whether the offset would lie beyond bounds from the other side, at ten times RATE_PRIOR."""
    return any(beyond + y < -10.0 * RATE_PRIOR * abs(at - x) for x, y in other)
