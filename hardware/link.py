"""The link to a device that may go and come back: its state, and drivers that tell of it."""

from collections.abc import Callable
from dataclasses import dataclass, field
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
