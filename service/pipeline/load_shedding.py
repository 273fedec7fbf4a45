"""LoadShedding: in which frames markers and tools are tracked when there is no time for all.

A computer that is too slow for all frames tracks in as many as it can, evenly, instead of in all
for a while and then in none: tracks lose some of their readings, and no pose is late.
"""

import math
from collections import deque
from collections.abc import Sequence
from statistics import median
from typing import Final

SLICE_S: Final = 0.004
"""Time for a batch when tracking skips frames: poses are late by twice that at most, and the
devices that share the thread wait for as long."""
BEGIN_S: Final = 0.02
"""When frames of more time wait, tracking begins to skip frames."""
END_S: Final = 0.25
"""When there was time for all frames for this long, all are tracked again."""
BEHIND_S: Final = 0.1
"""When frames of more time wait, none is tracked: its pose would be as old."""
CAUGHT_UP_S: Final = 0.02
"""When no more than that waits, some are again."""

_COSTS: Final = 9
"""Batches of which the median cost counts: a search now and then, or a hiccup, does not."""


class LoadShedding:
    """Decides in which frames of one device tracking runs, from how many wait and what they cost.

    It has no clock: times are given. All frames are tracked until frames of BEGIN_S wait. Then a
    batch has SLICE_S, however many frames it holds, or the time of one: batches grow until that is
    enough, and the devices of a thread get the same time each. Tracked are the frames whose strobe
    slot was left out for the longest time, so that no marker is neglected, and of equals the
    newest. Every n-th frame would never show some markers of a strobe whose number has a divisor
    in common with n; whole strobe cycles with gaps between would leave longer gaps.

    Args:
        rate_hz: of the device's frames; 0: not known, then all are tracked.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_s = 1.0 / rate_hz if rate_hz > 0.0 else 0.0
        self._thins = self._behind = False
        self._tracking_s: deque[float] = deque(maxlen=_COSTS)  # of a frame
        self._rest_s: deque[float] = deque(maxlen=_COSTS)  # of a batch
        self._enough = 0  # frames in a row for which there was time
        self._count = 0
        self._last: dict[int | None, int] = {}  # newest tracked frame of each slot

    @property
    def sheds(self) -> bool:
        """Whether tracking may skip frames."""
        return self._thins

    @property
    def behind(self) -> bool:
        """Whether tracking skips all frames until it has caught up."""
        return self._behind

    def choose(self, slots: Sequence[int | None], waiting: int) -> tuple[bool, ...]:
        """Return in which of the next frames markers and tools are tracked.

        Frames behind the last tracked one are left for the next batch, so that the newest frame
        of a batch has poses: there may be fewer answers than frames, but at least one.

        Args:
            slots: strobe slot of each frame, oldest first; None: all markers are lit.
            waiting: frames that wait behind them.
        """
        later_s = (len(slots) + waiting - 1) * self._period_s
        self._behind = later_s > (CAUGHT_UP_S if self._behind else BEHIND_S)
        self._thins = self._thins or later_s > BEGIN_S
        if self._behind:
            self._enough = 0
            chosen = [False] * len(slots)
        elif self._thins:
            chosen = self._chosen(slots, self._affordable(len(slots)))
        else:
            chosen = [True] * len(slots)
        if True in chosen:
            while not chosen[-1]:
                chosen.pop()
        self._remember(slots, chosen)
        return tuple(chosen)

    def count(self, tracked: int, tracking_s: float, rest_s: float) -> None:
        """Learn what a batch cost.

        Args:
            tracked: in how many of its frames markers and tools were tracked.
            tracking_s: how long that took [s].
            rest_s: how long all else took [s].
        """
        self._rest_s.append(rest_s)
        if tracked:
            self._tracking_s.append(tracking_s / tracked)

    def _affordable(self, frames: int) -> int:
        """Return in how many of the frames there is time to track: in one at least."""
        rest_s = median(self._rest_s) if self._rest_s else 0.0
        frame_s = max(median(self._tracking_s) if self._tracking_s else 0.0, 1e-6)
        most = min(max(1, int((SLICE_S - rest_s) / frame_s)), frames)
        self._enough = self._enough + frames if most == frames else 0
        if self._enough * self._period_s > END_S:
            self._thins, self._enough = False, 0
        return most

    def _chosen(self, slots: Sequence[int | None], most: int) -> list[bool]:
        """Choose the frame farthest from all tracked ones of its strobe slot, and so on."""
        if most == len(slots):
            return [True] * len(slots)
        far = [
            self._count + index - self._last.get(slot, -math.inf)
            for index, slot in enumerate(slots)
        ]
        chosen = [False] * len(slots)
        for _ in range(most):
            best = max(range(len(slots)), key=lambda index: (far[index], index))
            chosen[best] = True
            for index, slot in enumerate(slots):
                if slot == slots[best]:
                    far[index] = min(far[index], abs(index - best))
        return chosen

    def _remember(self, slots: Sequence[int | None], chosen: Sequence[bool]) -> None:
        for index, taken in enumerate(chosen):
            if taken:
                self._last[slots[index]] = self._count + index
        self._count += len(chosen)
