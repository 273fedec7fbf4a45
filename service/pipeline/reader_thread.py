"""ReaderThread: puts a driver's frames into a FrameRing, from which the compute thread takes."""

import logging
from collections import deque
from collections.abc import Callable, Sequence
from itertools import islice
from threading import Event, Lock, Thread
from typing import Final, Literal, TypeVar

from compute.errors import LumilineError
from hardware.driver import Driver
from hardware.line_frame import LineFrame
from hardware.link import LinkedDriver, LinkState
from service.logs import set_device_id

_log = logging.getLogger(__name__)

ReaderState = Literal["running", "stopped", "ended", "failed"]

T = TypeVar("T")

JOIN_TIMEOUT_S: Final = 5.0
_ROOM_POLL_S: Final = 0.1


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
                self._taken.wait(_ROOM_POLL_S)

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

    def take_chosen(
        self, most: int, choose: Callable[[Sequence[LineFrame], int], Sequence[T]]
    ) -> tuple[list[LineFrame], list[T]]:
        """Remove and return the oldest frames for which ``choose`` has an answer, and the answers.

        Args:
            most: how many frames ``choose`` is shown at most.
            choose: gets frames, oldest first, and how many more wait; returns an answer for the
                first of them, or for all. It is called with the ring locked, and not without a
                frame.
        """
        with self._lock:
            shown = list(islice(self._frames, most))
            chosen = list(choose(shown, len(self._frames) - len(shown))) if shown else []
            for _ in chosen:
                self._frames.popleft()
        self._taken.set()
        return shown[: len(chosen)], chosen

    def __len__(self) -> int:
        """Return the number of frames that wait."""
        return len(self._frames)


class ReaderThread:
    """Runs a driver's blocking generator in a thread of its own until it ends or is stopped."""

    def __init__(
        self,
        device_id: str,
        driver: Driver,
        ring: FrameRing,
        ended: Callable[[], object],
        link_changed: Callable[[], object],
    ) -> None:
        """Prepare the thread.

        From it ``ended`` is called when the frames end by themselves, and ``link_changed`` when
        the device was lost, came back, or sends nothing of use.
        """
        self.state: ReaderState = "running"
        self.reason: str | None = None
        self._device_id = device_id
        self._driver = driver
        self._ring = ring
        self._ended = ended
        self._stopping = False
        self.lossless = driver.lossless
        """Whether the source waits for the pipeline: a replay as fast as frames are consumed."""
        self._thread = Thread(target=self._run, name=f"reader-{device_id}", daemon=True)

        self._link_changed = link_changed
        self._linked = driver if isinstance(driver, LinkedDriver) else None

    def start(self) -> None:
        """Start to read; the driver is open."""
        if self._linked is not None:
            self._linked.listen(self._told)
        self._thread.start()

    def link(self) -> LinkState | None:
        """Return how the link to the device stands; None of a device that cannot be unplugged."""
        return None if self._linked is None else self._linked.link()

    def _told(self, _: LinkState) -> None:
        if not self._stopping:
            self._link_changed()

    def close_driver(self) -> None:
        """End the frames without waiting for the thread."""
        self._stopping = True
        self._driver.close()

    def stop(self) -> None:
        """Close the driver and wait for the thread."""
        self.close_driver()
        self._thread.join(JOIN_TIMEOUT_S)
        if self._thread.is_alive():
            _log.error("device %s: its reader did not end %g s after closing the driver",
                       self._device_id, JOIN_TIMEOUT_S)  # fmt: skip
        if self.state == "running":
            self.state = "stopped"

    def _run(self) -> None:
        set_device_id(self._device_id)
        try:
            for frame in self._driver.frames():
                if self.lossless:
                    self._ring.wait_for_room(lambda: self._stopping)
                self._ring.put(frame)
        except LumilineError as error:
            self.reason, self.state = error.detail, "failed"
        except Exception as error:  # noqa: BLE001 - becomes the status
            _log.exception("device %s: its driver failed", self._device_id)
            self.reason, self.state = f"the driver failed: {type(error).__name__}", "failed"
        else:
            if not self._stopping:
                self.reason, self.state = "the source has no more frames", "ended"
        finally:
            if not self._stopping:
                self._driver.close()
                self._ended()
