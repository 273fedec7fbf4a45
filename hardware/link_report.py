"""LinkReport: what a driver keeps of its link, and whom it tells."""

from collections.abc import Callable
from dataclasses import replace
from threading import Lock

from hardware.link import LinkCounters, LinkPhase, LinkState


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
