"""A bounded ring of frames between a reader thread and the compute thread."""

from collections import deque
from collections.abc import Callable, Sequence
from threading import Event, Lock
from typing import Final

from hardware.line_frame import LineFrame

_LOOK_S: Final = 0.1


class FrameRing:
    """Holds at most ``capacity`` frames; when full, the oldest is dropped and counted.

    Frames are handed over by reference: a driver does not write to a frame again.
    """

    def __init__(self, capacity: int, notify: Callable[[], None]) -> None:
        """Create a ring that calls ``notify`` after each frame that is put in."""
        self._frames: deque[LineFrame] = deque()
        self._capacity = capacity
        self._notify = notify
        self._lock = Lock()
        self._taken = Event()
        self._last: int | None = None
        self.received = 0
        """Frames put in."""
        self.lost = 0
        """Exposures missing in the sequence numbers: lost in the device or on the way."""
        self.dropped = 0
        """Frames dropped here because nobody took them in time."""

    def put(self, frame: LineFrame) -> None:
        """Add a frame; never blocks."""
        with self._lock:
            self.received += 1
            if self._last is not None and frame.sequence > self._last + 1:
                self.lost += frame.sequence - self._last - 1
            self._last = frame.sequence
            if len(self._frames) == self._capacity:
                self._frames.popleft()
                self.dropped += 1
            self._frames.append(frame)
        self._notify()

    def wait_for_room(self, given_up: Callable[[], bool]) -> None:
        """Wait until a frame can be put without dropping another, for sources that can wait."""
        while len(self._frames) >= self._capacity and not given_up():
            self._taken.clear()
            if len(self._frames) >= self._capacity:
                self._taken.wait(_LOOK_S)

    @property
    def last_sequence(self) -> int:
        """Sequence number of the newest frame that was put in; -1 before the first."""
        last = self._last
        return -1 if last is None else last

    def take(self, most: int) -> list[LineFrame]:
        """Remove and return up to ``most`` frames, oldest first."""
        with self._lock:
            if len(self._frames) <= most:
                taken = list(self._frames)
                self._frames.clear()
            else:
                taken = [self._frames.popleft() for _ in range(most)]
        self._taken.set()
        return taken

    def put_back(self, frames: Sequence[LineFrame]) -> None:
        """Put frames that were taken, and not worked on, back in front of all others."""
        with self._lock:
            self._frames.extendleft(reversed(frames))
            while len(self._frames) > self._capacity:
                self._frames.popleft()
                self.dropped += 1

    def __len__(self) -> int:
        """Return the number of frames that wait."""
        return len(self._frames)
