"""Clock synchronisation: host times of exposures from device ticks and frame arrivals.

A frame arrives late, never early: the line, the operating system and a busy host add delays of
one sign. A regression averages them in; the earliest arrivals do not have them. So the clock is
the highest straight line below the arrivals (Moon, Skelly, Towsley, "Estimation and removal of
clock skew from network delay measurements", IEEE INFOCOM 1999, doi 10.1109/INFCOM.1999.749287),
over the earliest arrival of each quarter of a second, older ones with less weight.
docs/how-to/devices.md compares both.
"""

import math
import time
from collections import deque
from dataclasses import dataclass
from itertools import pairwise
from threading import Event
from typing import Final

from compute.errors import InvalidParameter

BUCKET_NS: Final = 250_000_000
"""Length of a bucket; only the earliest arrival of each bucket is kept."""
BUCKETS: Final = 240
DECAY_NS: Final = 20e9
"""Time constant of the exponential weights of past arrivals."""
RATE_PRIOR: Final = 1e-4
"""Prior standard deviation of a crystal's relative rate error."""
MAX_LEAD_NS: Final = 500_000_000
"""A clock further ahead of its arrivals than this, or one that goes back, was reset."""
MIN_WRAP_NS: Final = 50_000_000
"""Shortest wrap-around period that can be counted; arrivals are late by as much."""
RECENT_NS: Final = 1_000_000_000
"""Window of the lower bound of the error: the smallest recent distance above the line."""
MIN_UNCERTAINTY_NS: Final = 1_000.0
"""Lower bound of the stated uncertainty."""
BRACKET_NS: Final = 20_000
"""Two clocks are read again where both reads together took longer."""
MAX_READS: Final = 20
"""Then the narrowest of so many brackets counts."""
SET_BACK_NS: Final = 1_000_000_000
"""The host's clock was set back where an exposure's time is earlier than the last by as much."""


@dataclass(frozen=True, slots=True)
class ExposureTimestamp:
    """Time of an exposure on the device's clock and on the host's.

    Args:
        device_ns: on the device's clock, continued over resets of the clock [ns].
        host_ns: on the host's monotonic clock [ns].
        restarted: whether the clock was reset before this exposure.
    """

    device_ns: int
    host_ns: int
    restarted: bool


class DeviceClock:
    """Maps ticks of a clock that wraps after 2**bits to the host's monotonic clock.

    Args:
        ticks_per_s: the clock's nominal rate.
        bits: its width. Wrap-arounds are counted correctly while no exposure arrives late by
            more than a wrap period less MAX_LEAD_NS, or, where that is less, by half a period.
        delay_ns: known time from the moment of the ticks to the earliest possible arrival.

    Raises:
        InvalidParameter: it wraps after less than MIN_WRAP_NS.
    """

    def __init__(self, ticks_per_s: int, bits: int = 64, delay_ns: int = 0) -> None:
        self.restarts = 0
        self._base_ns = 0
        self._set(ticks_per_s, bits, delay_ns)
        self._last_ticks: int | None = None
        self._rate = 0.0
        self._offset_ns = math.inf
        self._begin(0, 0.0)

    @property
    def uncertainty_ns(self) -> float:
        """Standard deviation of host times, beyond the shortest delay [ns]; inf at first."""
        return self._uncertainty_ns

    @property
    def rate(self) -> float:
        """Relative rate error: length of a device second on the host's clock, less one."""
        return self._rate

    def stamp(self, ticks: int, arrival_ns: int) -> ExposureTimestamp:
        """Return the time of an exposure from its ticks and its monotonic arrival time [ns]."""
        unwrapped = self._unwrap(ticks, arrival_ns)
        restarted = unwrapped is None and self._last_ticks is not None
        if unwrapped is None:
            self.restart(arrival_ns, counted=restarted)
            self._first_ticks = self._last_ticks = unwrapped = ticks
        self._last_ticks = unwrapped
        elapsed_ns = (unwrapped - self._first_ticks) * 1_000_000_000 // self._per_s
        late_ns = arrival_ns - self._origin_ns - elapsed_ns
        self._add_arrival(elapsed_ns, late_ns)
        line_ns = self._offset_ns + self._rate * elapsed_ns
        if late_ns < line_ns:  # earlier than any before: the line was too high
            self._offset_ns -= line_ns - late_ns
            line_ns = late_ns
        self._latest_ns = elapsed_ns
        host_ns = self._origin_ns + elapsed_ns + round(line_ns) - self._delay_ns
        return ExposureTimestamp(self._base_ns + elapsed_ns, host_ns, restarted)

    def restart(self, arrival_ns: int, *, counted: bool = True) -> None:
        """Restart with the next exposure, after a reset of the device; the rate is kept."""
        if self._last_ticks is not None:
            self.restarts += counted
            elapsed_ns = arrival_ns - self._origin_ns - round(self._offset_ns)
            self._base_ns += max(self._latest_ns, elapsed_ns)
        self._last_ticks = None
        self._begin(arrival_ns, self._rate)

    def reconfigure(self, ticks_per_s: int, bits: int, delay_ns: int, now_ns: int) -> bool:
        """Continue with another clock from a monotonic time [ns]; raises as the class does.

        Returns:
            Whether the rate or the width changed; another delay alone is the same clock.
        """
        other = (ticks_per_s, 2**bits) != (self._per_s, self._wrap)
        self._set(ticks_per_s, bits, delay_ns)
        if other:
            self.restart(now_ns)
            self._begin(now_ns, 0.0)
        return other

    def _set(self, ticks_per_s: int, bits: int, delay_ns: int) -> None:
        wrap_ns = 2**bits * 1_000_000_000 // ticks_per_s
        if wrap_ns < MIN_WRAP_NS:
            raise InvalidParameter(
                f"a clock of {bits} bits at {ticks_per_s:,} ticks a second wraps around every "
                f"{wrap_ns * 1e-6:.3g} ms; it must be {MIN_WRAP_NS // 1_000_000} ms at least: "
                "let the device count the wraps, or tick more slowly",
                bits=bits,
                ticks_per_s=ticks_per_s,
            )
        self._per_s = ticks_per_s
        self._wrap = 2**bits
        self._slack_ns = min(MAX_LEAD_NS, wrap_ns // 2)
        self._delay_ns = delay_ns

    def _begin(self, origin_ns: int, rate: float) -> None:
        self._origin_ns = origin_ns
        self._first_ticks = 0
        self._latest_ns = 0
        self._rate = rate
        self._nominal_rate = rate
        self._offset_ns = math.inf
        self._uncertainty_ns = math.inf
        self._earliest: tuple[int, int] | None = None
        self._bucket = 0
        self._points: deque[tuple[int, int]] = deque(maxlen=BUCKETS)

    def _unwrap(self, ticks: int, arrival_ns: int) -> int | None:
        """Return the ticks with wrap-arounds added; None: the clock was reset."""
        if self._last_ticks is None:
            return None
        # What the clock shows now: an exposure is not after its arrival, but for the slack.
        elapsed_ns = arrival_ns - self._origin_ns - self._offset_ns - self._rate * self._latest_ns
        newest = self._first_ticks + int((elapsed_ns + self._slack_ns) * self._per_s * 1e-9)
        step = (ticks - self._last_ticks) % self._wrap
        wraps = max(0, (newest - self._last_ticks - step) // self._wrap)
        unwrapped: int = self._last_ticks + step + wraps * self._wrap
        # A clock of short wraps may be ahead of itself by one or two, after a stall of the host.
        ahead = int((MAX_LEAD_NS - self._slack_ns) * self._per_s * 1e-9)
        return unwrapped if unwrapped <= newest + ahead else None

    def _add_arrival(self, elapsed_ns: int, late_ns: int) -> None:
        """Keep the earliest arrival of each bucket; refit the line with each new bucket."""
        bucket = elapsed_ns // BUCKET_NS
        if self._earliest is not None and bucket != self._bucket:
            self._points.append(self._earliest)
            self._earliest = None
            self._fit_hull_edge()
        self._bucket = bucket
        beyond = late_ns - self._rate * elapsed_ns
        if self._earliest is None or beyond < self._earliest[1] - self._rate * self._earliest[0]:
            self._earliest = (elapsed_ns, late_ns)
        self._offset_ns = min(self._offset_ns, beyond)

    def _fit_hull_edge(self) -> None:
        """Fit the line below the kept arrivals."""
        points = self._points
        now = points[-1][0]
        edge = fit_lower_edge(list(points), self._rate, self._nominal_rate)
        self._rate = edge.rate
        self._offset_ns = min(y - self._rate * x for x, y in points)
        # A clock that lost ticks, or became slower: all that comes now is above the line.
        recent = (x_y for x_y in reversed(points) if x_y[0] > now - RECENT_NS)
        beyond = min(y - self._rate * x for x, y in recent) - self._offset_ns
        self._uncertainty_ns = max(edge.sigma_ns, beyond)


@dataclass(frozen=True, slots=True)
class LowerEdge:
    """Line below arrivals, of times and their excess delays.

    Args:
        rate: its slope, weighed with the nominal one.
        sigma_ns: standard deviation of its height [ns].
        rate_sigma: standard deviation of the slope by the arrivals alone.
    """

    rate: float
    sigma_ns: float
    rate_sigma: float


def fit_lower_edge(
    points: list[tuple[int, int]], last_rate: float, nominal_rate: float
) -> LowerEdge:
    """Fit the line below points with the smallest weighted sum of distances.

    Args:
        points: times and excess delays, one or more, by ascending time [ns].
        last_rate: slope where there is one point only.
        nominal_rate: slope before any is known, good to RATE_PRIOR.
    """
    now = points[-1][0]
    weights = [math.exp((x - now) / DECAY_NS) for x, _ in points]
    centre_ns = sum(w * x for w, (x, _) in zip(weights, points, strict=True)) / sum(weights)
    left, right = _edge_below(points, centre_ns)
    rate = (right[1] - left[1]) / (right[0] - left[0]) if right[0] > left[0] else last_rate
    offset = min(y - rate * x for x, y in points)
    above = _median([y - rate * x - offset for x, y in points], weights)
    sigma = max(1.5 * above * (1.0 + 2.0 / len(points)), MIN_UNCERTAINTY_NS)
    # Weight of the fitted rate against the prior: both arrivals may be off by sigma.
    rate_sigma = 2.0 * sigma / max(right[0] - left[0], 1)
    weight = RATE_PRIOR**2 / (RATE_PRIOR**2 + rate_sigma**2)
    return LowerEdge(nominal_rate + weight * (rate - nominal_rate), sigma, rate_sigma)


def _edge_below(
    points: list[tuple[int, int]], centre_ns: float
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the edge of the lower convex hull at an abscissa; points are sorted by x."""
    hull: list[tuple[int, int]] = []
    for x, y in points:
        while len(hull) > 1:
            (x0, y0), (x1, y1) = hull[-2:]
            if (y1 - y0) * (x - x0) < (y - y0) * (x1 - x0):
                break
            hull.pop()
        hull.append((x, y))
    for left, right in pairwise(hull):
        if right[0] >= centre_ns:
            return left, right
    return hull[-1], hull[-1]


def _median(values: list[float], weights: list[float]) -> float:
    """Return the weighted median, which is robust against stalls of the host."""
    half, below = 0.5 * sum(weights), 0.0
    ordered = sorted(zip(values, weights, strict=True))
    for value, weight in ordered:
        below += weight
        if below >= half:
            return value
    return ordered[-1][0]


def wait_until(due_ns: int, closed: Event) -> None:
    """Wait until a time of the monotonic clock [ns]; return at once when the event is set."""
    remaining_ns = due_ns - time.monotonic_ns()
    if remaining_ns > 0:
        closed.wait(remaining_ns * 1e-9)


def host_clock_offset_ns() -> int:
    """Return what time.time_ns() is ahead of time.monotonic_ns() [ns].

    Between the reads of both clocks this thread may have to wait for the processor: the reads are
    bracketed, and repeated where the bracket is wide.
    """
    narrowest_ns, offset_ns = -1, 0
    for _ in range(MAX_READS):
        before_ns, wall_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        bracket_ns = after_ns - before_ns
        if narrowest_ns < 0 or bracket_ns < narrowest_ns:
            narrowest_ns, offset_ns = bracket_ns, wall_ns - (before_ns + after_ns) // 2
        if bracket_ns <= BRACKET_NS:
            break
    return offset_ns


class HostClock:
    """Converts the monotonic times of one device's exposures to the clock of time.time_ns().

    The offset is read again for each, because the host's clock may have been set meanwhile. Times
    rise strictly; only a clock that was set back by SET_BACK_NS or more takes them back with it.
    """

    def __init__(self) -> None:
        self._monotonic_ns = self._host_ns = -(2**63)

    def convert(self, monotonic_ns: int) -> tuple[int, int]:
        """Return an exposure's time on the monotonic clock and on the host's [ns].

        Args:
            monotonic_ns: as measured; where it does not rise, the last one and 1 ns count.
        """
        self._monotonic_ns = max(monotonic_ns, self._monotonic_ns + 1)
        host_ns = self._monotonic_ns + host_clock_offset_ns()
        if host_ns > self._host_ns - SET_BACK_NS:
            host_ns = max(host_ns, self._host_ns + 1)
        self._host_ns = host_ns
        return self._monotonic_ns, host_ns
