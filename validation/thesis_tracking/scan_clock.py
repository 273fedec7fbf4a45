"""Sampling period and scan count from exposure times."""

from statistics import median
from typing import Final

_REMEMBERED: Final = 15


class ScanClock:
    """The thesis's methods count scans, "taken as equally far apart"; devices tell times.

    The period is the median of the last intervals, so that an exposure which is lost on the way
    is a scan without points, and uneven times are none.
    """

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._intervals_s: list[float] = []

    @property
    def last_ns(self) -> int | None:
        """The time of the last exposure; None: there was none."""
        return self._last_ns

    @property
    def interval_s(self) -> float:
        """The sampling period; 1 until two exposures have told it."""
        return median(self._intervals_s) if self._intervals_s else 1.0

    def step(self, time_ns: int) -> int:
        """Return how many scans after the last exposure this one is, 1 or more."""
        last, self._last_ns = self._last_ns, time_ns
        if last is None:
            return 1
        since_s = (time_ns - last) * 1e-9
        scans = max(1, round(since_s / self.interval_s)) if self._intervals_s else 1
        self._intervals_s.append(since_s / scans)
        del self._intervals_s[:-_REMEMBERED]
        return scans
