"""Matches scans of several cameras by exposure time."""

from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

MAX_PENDING_SCANS: Final = 4096
"""Maximum number of scans per camera that wait for a match; the oldest are dropped."""


@dataclass(frozen=True, eq=False, slots=True)
class CameraScan:
    """One scan of one camera.

    Args:
        number: of the exposure, since the driver was opened; gaps are lost ones.
        device_ns: middle of the exposure on the camera's clock [ns].
        monotonic_ns: the same on the host's monotonic clock, which nobody sets [ns].
        counts: uint16, shape (pixels,).
        restarts: number of resets and reconnections of the camera until then.
    """

    number: int
    device_ns: int
    monotonic_ns: int
    counts: NDArray[np.uint16]
    restarts: int = 0


class FrameSynchroniser:
    """Groups time-ordered scans into sets of one scan of each camera.

    Args:
        cameras: number of cameras.
        tolerance_ns: largest difference between the monotonic times of scans of one exposure;
            less than half the exposure period.
    """

    def __init__(self, cameras: int, tolerance_ns: int) -> None:
        self.unmatched = 0
        """Scans dropped because another camera had no match."""
        self._waiting: list[deque[CameraScan]] = [deque() for _ in range(cameras)]
        self._tolerance_ns = tolerance_ns

    def add(self, camera: int, line: CameraScan) -> None:
        """Add a scan; the monotonic times of one camera must not decrease."""
        waiting = self._waiting[camera]
        if len(waiting) >= MAX_PENDING_SCANS:
            waiting.popleft()
            self.unmatched += 1
        waiting.append(line)

    def take(self) -> tuple[CameraScan, ...] | None:
        """Return the next set, in the order of the cameras; None: not complete yet."""
        while all(self._waiting):
            oldest = [waiting[0] for waiting in self._waiting]
            latest = max(line.monotonic_ns for line in oldest)
            late = [
                waiting
                for waiting, line in zip(self._waiting, oldest, strict=True)
                if line.monotonic_ns < latest - self._tolerance_ns
            ]
            if not late:
                for waiting in self._waiting:
                    waiting.popleft()
                return tuple(oldest)
            for waiting in late:
                waiting.popleft()
                self.unmatched += 1
        return None

    def forget(self) -> None:
        """Drop all waiting scans, after the loss of a camera."""
        for waiting in self._waiting:
            self.unmatched += len(waiting)
            waiting.clear()
