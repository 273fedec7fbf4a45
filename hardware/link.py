"""The link to a device that may go and come back: its state, and drivers that tell of it."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from threading import Lock
from typing import Literal, Protocol, runtime_checkable

LinkPhase = Literal["connected", "silent", "garbled", "disconnected"]
"""Frames come; connected, but nothing comes; something comes, but no frames; not there."""


@dataclass(frozen=True)
class LinkCounters:
    """What came over a link since the driver was opened.

    Args:
        bytes_received: bytes that came.
        frames: whole frames handed on.
        frames_garbled: messages thrown away: damaged, cut short, or of another protocol.
        frames_incomplete: exposures of which parts were missing, thrown away.
        frames_lost: exposures missing in the device's own sequence numbers.
        reconnects: how often the device came back.
        clock_restarts: how often its clock began anew.
    """

    bytes_received: int = 0
    frames: int = 0
    frames_garbled: int = 0
    frames_incomplete: int = 0
    frames_lost: int = 0
    reconnects: int = 0
    clock_restarts: int = 0


@dataclass(frozen=True)
class LinkState:
    """How a link stands.

    Args:
        state: connected, silent, garbled or disconnected.
        reason: why it is not connected, and what is done about it; None when it is.
        counters: what came over it.
        clock_uncertainty_us: of exposures' host times, beyond the shortest delay of the link [us];
            None: not known, or not yet.
        temperature_c: what the device last said of its temperature [degrees C]; None: nothing.
    """

    state: LinkPhase
    reason: str | None = None
    counters: LinkCounters = field(default_factory=LinkCounters)
    clock_uncertainty_us: float | None = None
    temperature_c: float | None = None


@runtime_checkable
class LinkedDriver(Protocol):
    """A driver whose device may go and come back; beside ``hardware.driver.Driver``.

    Its ``open`` raises DeviceNotConnected where the device is not there (it may be tried again),
    within a few seconds, and at once when ``close`` is called meanwhile. Its ``frames`` goes on
    when the device is lost, and yields frames again when it is back: with sequence numbers and
    device times that continue. A device that comes back with other sensors ends it with
    DeviceChanged.
    """

    def listen(self, changed: Callable[[LinkState], None]) -> None:
        """Have each change of the state or its reason told, from the thread of ``frames``."""
        ...

    def link(self) -> LinkState:
        """Return how the link stands; callable from any thread."""
        ...


class LinkReport:
    """The state of a link and its counters; callable from any thread."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._state = LinkState("connected")
        self._changed: Callable[[LinkState], None] | None = None

    def listen(self, changed: Callable[[LinkState], None]) -> None:
        """Have each change of the state or its reason told, from the thread that causes it."""
        self._changed = changed

    @property
    def state(self) -> LinkState:
        """How the link stands, with the counters."""
        with self._lock:
            return self._state

    def count(self, **more: int) -> None:
        """Add to counters, by their names in ``LinkCounters``."""
        with self._lock:
            old = self._state.counters
            sums = {name: getattr(old, name) + number for name, number in more.items()}
            self._state = replace(self._state, counters=replace(old, **sums))

    def tell(self, phase: LinkPhase, reason: str | None = None) -> None:
        """Set the state; the listener hears of it when it, or its reason, is another one."""
        with self._lock:
            changed = (phase, reason) != (self._state.state, self._state.reason)
            if changed:
                self._state = replace(self._state, state=phase, reason=reason)
            state = self._state
        if changed and self._changed is not None:
            self._changed(state)

    def begin(self) -> None:
        """Begin anew: connected, with all counters at zero."""
        with self._lock:
            self._state = LinkState("connected", None, LinkCounters())
