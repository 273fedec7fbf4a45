"""Latency: how long batches took from exposure to publication, counted in classes."""

from bisect import bisect_left
from dataclasses import dataclass
from typing import Final

BOUNDS_S: Final = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
"""Upper bounds of the classes [s]; one more, without a bound, follows."""


@dataclass(frozen=True)
class LatencyCounts:
    """Latencies by class.

    Args:
        counts: batches in each class of BOUNDS_S, and in the one behind it.
        sum_s: of all latencies [s].
    """

    counts: tuple[int, ...] = (0,) * (len(BOUNDS_S) + 1)
    sum_s: float = 0.0


class LatencyHistogram:
    """Counted by one thread, read by any; a lock would cost more than the counting."""

    def __init__(self) -> None:
        self._counts = [0] * (len(BOUNDS_S) + 1)
        self._sum_s = 0.0

    def count(self, latency_s: float) -> None:
        """Count a batch; a clock that was set back makes no negative latency."""
        latency_s = max(latency_s, 0.0)
        self._counts[bisect_left(BOUNDS_S, latency_s)] += 1
        self._sum_s += latency_s

    def counts(self) -> LatencyCounts:
        """Return what was counted so far."""
        return LatencyCounts(tuple(self._counts), self._sum_s)
