"""Puts lines of several cameras together that were exposed at one moment."""

from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

MAX_PENDING_SCANS: Final = 4096
"""Lines of one camera that wait for those of the others; older ones are given up."""


@dataclass(frozen=True, eq=False, slots=True)
class CameraScan:
    """One line of one camera.

    Args:
        number: of the exposure, since the driver was opened; gaps are lost ones.
        device_ns: middle of the exposure on the camera's clock [ns].
        monotonic_ns: the same on the host's monotonic clock, which nobody sets [ns].
        counts: uint16, shape (pixels,).
        restarts: how often the camera had begun anew by then, or was opened again.
    """

    number: int
    device_ns: int
    monotonic_ns: int
    counts: NDArray[np.uint16]
    restarts: int = 0


class FrameSynchroniser:
    """Lines of each camera in order of time go in, sets of one line of each come out.

    Args:
        cameras: how many.
        tolerance_ns: how far the monotonic times of lines of one exposure may lie apart; less than
            half the time between two.
    """

    def __init__(self, cameras: int, tolerance_ns: int) -> None:
        self.unmatched = 0
        """Lines given up, because another camera had none for them."""
        self._waiting: list[deque[CameraScan]] = [deque() for _ in range(cameras)]
        self._tolerance_ns = tolerance_ns

    def add(self, camera: int, line: CameraScan) -> None:
        """Take a line; monotonic times of one camera must not go back."""
        waiting = self._waiting[camera]
        if len(waiting) >= MAX_PENDING_SCANS:
            waiting.popleft()
            self.unmatched += 1
        waiting.append(line)

    def take(self) -> tuple[CameraScan, ...] | None:
        """Return the next set, in the order of the cameras; None: one has nothing yet."""
        while all(self._waiting):
            heads = [waiting[0] for waiting in self._waiting]
            latest = max(line.monotonic_ns for line in heads)
            late = [
                waiting
                for waiting, line in zip(self._waiting, heads, strict=True)
                if line.monotonic_ns < latest - self._tolerance_ns
            ]
            if not late:
                for waiting in self._waiting:
                    waiting.popleft()
                return tuple(heads)
            for waiting in late:
                waiting.popleft()
                self.unmatched += 1
        return None

    def forget(self) -> None:
        """Give up all lines that wait: a camera was lost."""
        for waiting in self._waiting:
            self.unmatched += len(waiting)
            waiting.clear()
