"""Connection state of a device that may be unplugged: phases, counters, report to a listener."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from threading import Lock
from typing import Final, Literal, Protocol, runtime_checkable

from hardware.driver import S, SessionDriver

LinkPhase = Literal["connected", "silent", "garbled", "disconnected"]
"""Frames arrive; connected without data; data without valid frames; device not present."""

_BY_SEVERITY: Final[tuple[LinkPhase, ...]] = ("disconnected", "silent", "garbled")


def most_severe(faults: Iterable[tuple[LinkPhase, str]]) -> tuple[LinkPhase, str]:
    """Return the most severe of several faults, each a phase and its reason."""
    return min(faults, key=lambda fault: _BY_SEVERITY.index(fault[0]))


@dataclass(frozen=True)
class LinkCounters:
    """Traffic and error counters of a link since the driver was opened.

    Args:
        received_bytes: bytes received.
        frames_received: complete frames delivered.
        frames_garbled: messages discarded: damaged, truncated, or of another protocol.
        frames_incomplete: exposures discarded because parts were missing.
        frames_lost: exposures missing in the device's own sequence numbers.
        reconnects: number of reconnections.
        clock_restarts: number of resets of the device's clock.
    """

    received_bytes: int = 0
    frames_received: int = 0
    frames_garbled: int = 0
    frames_incomplete: int = 0
    frames_lost: int = 0
    reconnects: int = 0
    clock_restarts: int = 0


@dataclass(frozen=True)
class LinkState:
    """State of a link.

    Args:
        state: connected, silent, garbled or disconnected.
        reason: why it is not connected, and the remedy; None when it is.
        counters: its traffic and errors.
        clock_uncertainty_us: of exposures' host times, beyond the shortest delay of the link [us];
            None: not known, or not yet.
        clock_rate_ppm: relative rate error of the device's clock, by which its seconds are longer
            than the host's [ppm]; None: not known, or not yet.
        temperature_c: temperature last reported by the device [degrees C]; None: none.
    """

    state: LinkPhase
    reason: str | None = None
    counters: LinkCounters = field(default_factory=LinkCounters)
    clock_uncertainty_us: float | None = None
    clock_rate_ppm: float | None = None
    temperature_c: float | None = None


@runtime_checkable
class LinkedDriver(Protocol):
    """A driver that survives loss of its device; in addition to ``hardware.driver.Driver``.

    Its ``open`` raises DeviceNotConnected where the device is not there (it may be tried again),
    within a few seconds, and at once when ``close`` is called meanwhile. Its ``frames`` goes on
    when the device is lost, and yields frames again when it is back: with sequence numbers and
    device times that continue. A device that comes back with other sensors ends it with
    DeviceChanged.
    """

    def listen(self, changed: Callable[[LinkState], None]) -> None:
        """Register the listener of state changes; called from the thread of ``frames``."""
        ...

    def link(self) -> LinkState:
        """Return the state of the link; callable from any thread."""
        ...


class LinkReport:
    """Mutable state and counters of a link, with one listener; callable from any thread."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._state = LinkState("connected")
        self._changed: Callable[[LinkState], None] | None = None

    def listen(self, changed: Callable[[LinkState], None]) -> None:
        """Register the listener of state changes; called from the thread that causes them."""
        self._changed = changed

    @property
    def state(self) -> LinkState:
        """The state of the link, with the counters."""
        with self._lock:
            return self._state

    def count(self, **more: int) -> None:
        """Add to counters, by their names in ``LinkCounters``."""
        with self._lock:
            old = self._state.counters
            sums = {name: getattr(old, name) + number for name, number in more.items()}
            self._state = replace(self._state, counters=replace(old, **sums))

    def set_state(self, phase: LinkPhase, reason: str | None = None) -> None:
        """Set the state; notify the listener when the state or its reason changed."""
        with self._lock:
            changed = (phase, reason) != (self._state.state, self._state.reason)
            if changed:
                self._state = replace(self._state, state=phase, reason=reason)
            state = self._state
        if changed and self._changed is not None:
            self._changed(state)

    def reset(self) -> None:
        """Reset: connected, with all counters at zero."""
        with self._lock:
            self._state = LinkState("connected", None, LinkCounters())


class ReportingDriver(SessionDriver[S]):
    """Base of linked drivers that count and set their state in a ``LinkReport``."""

    def __init__(self) -> None:
        super().__init__()
        self._report = LinkReport()

    def listen(self, changed: Callable[[LinkState], None]) -> None:
        """Register the listener of link changes; see ``LinkedDriver``."""
        self._report.listen(changed)

    def link(self) -> LinkState:
        """Return the state of the device's links: the worst of them."""
        return self._report.state
