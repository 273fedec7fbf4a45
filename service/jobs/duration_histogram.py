"""DurationHistogram: durations of the runs of this server, by kind and outcome."""

from bisect import bisect_left
from threading import Lock
from typing import Final

from service.database.models import RunRow

BOUNDS_S: Final = (0.5, 1.0, 2.0, 5.0, 10.0, 30.0, 60.0, 300.0, 1800.0, 7200.0)
"""Upper bounds of the classes [s]; one more, without a bound, follows."""


class DurationHistogram:
    """Counts of each kind of run and how it ended; all methods may be called from any thread."""

    def __init__(self) -> None:
        self._counts: dict[tuple[str, ...], tuple[list[int], float]] = {}
        self._lock = Lock()

    def ended(self, row: RunRow) -> None:
        """Count a run that has ended."""
        if row.started_at is None or row.finished_at is None:
            return
        seconds = max((row.finished_at - row.started_at).total_seconds(), 0.0)
        key = (row.kind, row.state)
        with self._lock:
            counts, total = self._counts.get(key, ([0] * (len(BOUNDS_S) + 1), 0.0))
            counts[bisect_left(BOUNDS_S, seconds)] += 1
            self._counts[key] = counts, total + seconds

    def counts(self) -> dict[tuple[str, ...], tuple[tuple[int, ...], float]]:
        """Return by kind and state the counts of all classes, and the sum [s]."""
        with self._lock:
            return {key: (tuple(counts), total) for key, (counts, total) in self._counts.items()}
