"""StrobeCycle: the strobe period of each slot, learned from exposures."""

from collections import deque
from typing import Final

INTERVALS_KEPT: Final = 3
"""Times between exposures of a slot, of which the shortest counts: lost frames make others long."""
MAX_CYCLE_NS: Final = 1_000_000_000
"""A strobe that is slower is taken for one that was interrupted."""


class StrobeCycle:
    """Times between the exposures of each strobe slot."""

    def __init__(self) -> None:
        """Begin without any exposure."""
        self._last: dict[int, int] = {}
        self._between: dict[int, deque[int]] = {}

    def add_exposure(self, slot: int | None, time_ns: int) -> None:
        """Take in an exposure; of None, which lights all markers, nothing is learned."""
        if slot is None:
            return
        last = self._last.get(slot)
        self._last[slot] = time_ns
        if last is not None and time_ns - last <= MAX_CYCLE_NS:
            self._between.setdefault(slot, deque(maxlen=INTERVALS_KEPT)).append(time_ns - last)

    def duration_ns(self, slots: tuple[int, ...] | None) -> int:
        """Return how long a turn of the slots takes [ns]; 0: not known, or lit together."""
        known = [min(self._between[slot]) for slot in slots or () if slot in self._between]
        return max(known, default=0)

    def copy(self) -> "StrobeCycle":
        """Return one that knows as much, and learns by itself from now on."""
        other = StrobeCycle()
        other._last = dict(self._last)
        other._between = {
            slot: deque(one, maxlen=INTERVALS_KEPT) for slot, one in self._between.items()
        }
        return other
