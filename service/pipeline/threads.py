"""ReaderThread, ComputeThread: threads of the pipeline; FrameRing: the frames between them."""

import asyncio
import logging
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import suppress
from functools import cache
from itertools import islice
from queue import Empty, SimpleQueue
from threading import Event, Lock, Thread
from typing import Final, Literal, TypeVar

from compute.errors import LumilineError
from hardware.driver import Driver, IdlingDriver, PreparingDriver
from hardware.line_frame import LineFrame
from hardware.link import LinkedDriver, LinkState
from service.logs import set_device_id

_log = logging.getLogger(__name__)

ReaderState = Literal["running", "stopped", "ended", "failed"]

T = TypeVar("T")

JOIN_TIMEOUT_S: Final = 5.0
TAKE_OVER_S: Final = 0.01
"""A thread that has read a frame and is busy with it for longer is relieved: another reads on."""
MIN_RUN_TO_COMPLETION_HZ: Final = 200.0
"""Frames of slower devices are processed in the compute thread: its waking does not matter."""
_ROOM_POLL_S: Final = 0.1
_LATER_S: Final = 0.005


class FrameRing:
    """Holds at most ``capacity`` frames; when full, the oldest is dropped and counted.

    Frames are handed over by reference: a driver does not write to a frame again.
    """

    def __init__(self, capacity: int) -> None:
        """Create an empty ring."""
        self._frames: deque[LineFrame] = deque()
        self._capacity = capacity
        self._lock = Lock()
        self._room = Event()
        self._last: int | None = None
        self.received = 0
        """Frames put in."""
        self.lost = 0
        """Exposures missing in the sequence numbers: lost in the device or on the way."""
        self.dropped = 0
        """Frames dropped here because nobody took them in time."""
        self.sample: tuple[int, int] | None = None
        """Sequence number of the sampled frame, and when it was put in [ns since 1970]."""
        self._sample_requested = False

    def request_sample(self) -> None:
        """Note when the next frame is put in."""
        self._sample_requested = True

    def put(self, frame: LineFrame) -> None:
        """Add a frame; never blocks."""
        with self._lock:
            self.received += 1
            if self._last is not None and frame.sequence > self._last + 1:
                self.lost += frame.sequence - self._last - 1
            self._last = frame.sequence
            if self._sample_requested:
                self._sample_requested = False
                self.sample = (frame.sequence, time.time_ns())
            if len(self._frames) == self._capacity:
                self._frames.popleft()
                self.dropped += 1
            self._frames.append(frame)

    def wait_for_room(self, cancelled: Callable[[], bool]) -> None:
        """Wait until a frame can be put without dropping another, for sources that can wait."""
        while len(self._frames) >= self._capacity and not cancelled():
            self._room.clear()
            if len(self._frames) >= self._capacity:
                self._room.wait(_ROOM_POLL_S)

    @property
    def last_sequence(self) -> int:
        """Sequence number of the newest frame that was put in; -1 before the first."""
        last = self._last
        return -1 if last is None else last

    def take(self, limit: int) -> list[LineFrame]:
        """Remove and return up to ``limit`` frames, oldest first."""
        return self.take_chosen(limit, lambda frames, _: frames)[0]

    def take_chosen(
        self, limit: int, choose: Callable[[Sequence[LineFrame], int], Sequence[T]]
    ) -> tuple[list[LineFrame], list[T]]:
        """Remove and return the oldest frames for which ``choose`` has an answer, and the answers.

        Args:
            limit: how many frames ``choose`` is shown at most.
            choose: gets frames, oldest first, and how many more wait; returns an answer for the
                first of them, or for all. It is called with the ring locked, and not without a
                frame.
        """
        with self._lock:
            candidates = list(islice(self._frames, limit))
            chosen = (
                list(choose(candidates, len(self._frames) - len(candidates))) if candidates else []
            )
            for _ in chosen:
                self._frames.popleft()
        self._room.set()
        return candidates[: len(chosen)], chosen

    def __len__(self) -> int:
        """Return the number of frames that wait."""
        return len(self._frames)


class ReaderThread:
    """Runs a driver's blocking generator in a thread of its own until it ends or is stopped.

    A frame may be processed in the thread that has read it. So that others do not wait where nobody
    counts them, a second thread takes over the reading when that lasts: leader and followers
    (Schmidt et al., Pattern-Oriented Software Architecture, vol. 2).
    """

    def __init__(
        self,
        device_id: str,
        driver: Driver,
        ring: FrameRing,
        process: Callable[[], object],
        changed: Callable[[], object],
    ) -> None:
        """Prepare the threads.

        From one of them ``process`` is called after each frame that is put into the ring, and
        ``changed`` when the frames end by themselves, and when the device was lost, came back, or
        sends nothing of use.
        """
        self.state: ReaderState = "running"
        self.reason: str | None = None
        self._device_id = device_id
        self._driver = driver
        self._ring = ring
        self._process = process
        self._changed = changed
        self._stopping = False
        self.lossless = driver.lossless
        """Whether the source waits for the pipeline: a replay as fast as frames are consumed."""
        self._role = Lock()
        """Held while the role of the leader, which reads, goes from one to the other."""
        self._leader = 0
        self._away_s: float | None = None
        """Since when the leader processes what it has read; None: it reads."""
        self._frames: Iterator[LineFrame] | None = None
        self._over = Event()
        fast = driver.description.frame_rate_hz >= MIN_RUN_TO_COMPLETION_HZ
        names = ("reader", "standby") if fast and not driver.lossless else ("reader",)
        self._threads = [
            Thread(target=self._run, args=(number,), name=f"{name}-{device_id}", daemon=True)
            for number, name in enumerate(names)
        ]
        self._linked = driver if isinstance(driver, LinkedDriver) else None
        self._idling = driver if isinstance(driver, IdlingDriver) else None
        self._preparing = driver if isinstance(driver, PreparingDriver) else None

    def start(self) -> None:
        """Start to read; the driver is open."""
        if self._linked is not None:
            self._linked.listen(self._link_changed)
        if self.preparation is None:
            self._preparing = None
        for thread in self._threads:
            thread.start()

    def set_idle(self, *, idle: bool) -> None:
        """Tell a driver that can save work whether anybody looks at its pixels."""
        if self._idling is not None:
            self._idling.idle = idle

    @property
    def preparation(self) -> str | None:
        """What the driver does before its first frame; None: nothing any more."""
        preparing = self._preparing
        return None if preparing is None else preparing.preparation

    def link(self) -> LinkState | None:
        """Return how the link to the device stands; None of a device that cannot be unplugged."""
        return None if self._linked is None else self._linked.link()

    def _link_changed(self, _: LinkState) -> None:
        if not self._stopping:
            self._changed()

    def close_driver(self) -> None:
        """End the frames without waiting for the thread."""
        self._stopping = True
        self._driver.close()

    def stop(self) -> None:
        """Close the driver and wait for the threads."""
        self.close_driver()
        end_s = time.monotonic() + JOIN_TIMEOUT_S
        for thread in self._threads:
            thread.join(max(0.0, end_s - time.monotonic()))
        if any(thread.is_alive() for thread in self._threads):
            _log.error("device %s: its reader did not end %g s after closing the driver",
                       self._device_id, JOIN_TIMEOUT_S)  # fmt: skip
        self._over.set()
        if self.state == "running":
            self.state = "stopped"

    def _run(self, number: int) -> None:
        set_device_id(self._device_id)
        while number == self._leader or self._takes_over(number):
            if not self._read(number):
                return

    def _takes_over(self, number: int) -> bool:
        """Wait until the leader is away for too long, and lead; return False when all is over."""
        while not self._over.wait(TAKE_OVER_S):
            with self._role:
                away_s = self._away_s
                if away_s is not None and time.monotonic() - away_s > TAKE_OVER_S:
                    self._leader, self._away_s = number, None
                    return True
        return False

    def _read(self, number: int) -> bool:
        """Read frames while this thread leads; return whether the other has taken over."""
        while True:
            frame = self._next_frame()
            if frame is None:
                return False
            self._ring.put(frame)
            # Not before: the next frame, which the other thread may read from now on, comes behind.
            self._away_s = time.monotonic()
            try:
                self._process()
            except Exception:  # noqa: BLE001 - not of the driver; the next frames come all the same
                _log.exception("device %s: a frame could not be handed over", self._device_id)
            with self._role:
                if self._leader != number:
                    return True
                self._away_s = None

    def _next_frame(self) -> LineFrame | None:
        """Return the next frame; None: there is none, and what has ended them is known."""
        try:
            if self._frames is None:
                self._frames = iter(self._driver.frames())
            frame = next(self._frames, None)
            if frame is not None:
                if self._preparing is not None:
                    self._preparing = None
                    if not self._stopping:
                        self._changed()
                if self.lossless:
                    self._ring.wait_for_room(lambda: self._stopping)
                return frame
            if not self._stopping:
                self.reason, self.state = "the source has no more frames", "ended"
        except LumilineError as error:
            self.reason, self.state = error.detail, "failed"
        except Exception as error:  # noqa: BLE001 - becomes the status
            _log.exception("device %s: its driver failed", self._device_id)
            self.reason, self.state = f"the driver failed: {type(error).__name__}", "failed"
        self._over.set()
        if not self._stopping:
            self._driver.close()
            self._changed()
        return None


class ComputeThread:
    """Calls every registered worker whenever frames wait, and jobs, one after the other.

    ``work_now`` calls a worker in another thread, while this one waits: what must not run at the
    same time as workers, such as Warp, which is not thread-safe, is called by workers and jobs.

    A worker takes what is there and returns whether it did anything; the thread sleeps when
    none of them did and no frame has come since. A worker that returns None has something that it
    cannot do yet, and is called again soon. It runs from the beginning until ``close``.
    """

    def __init__(self) -> None:
        self._wake = Event()
        self._jobs: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._workers: dict[str, Callable[[], bool | None]] = {}
        self._turn = Lock()
        """Held while a worker or a job runs: one at a time, in whichever thread."""
        self._waits = False
        """Whether this thread waits for its turn: others leave it the next one."""
        self._closing = False
        self._since_s: float | None = None
        self._thread = Thread(target=self._run, name="compute", daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether the thread runs."""
        return self._thread.is_alive()

    @property
    def busy_s(self) -> float:
        """Time spent so far on the current batch or job [s]; 0 when idle."""
        since = self._since_s
        return 0.0 if since is None else time.monotonic() - since

    def wake(self) -> None:
        """Wake the thread: frames wait; callable from any thread, never blocks."""
        self._wake.set()

    def work_now(self, name: str) -> None:
        """Call a worker once in the calling thread, unless something else is to be done.

        What waits then still waits: the caller wakes the thread.
        """
        if (
            self._closing
            or self._waits
            or not self._jobs.empty()
            or not self._turn.acquire(blocking=False)
        ):
            return
        try:
            worker = self._workers.get(name)
            if worker is not None:
                self._call(name, worker)
        finally:
            self._since_s = None
            self._turn.release()

    def submit(self, job: Callable[[], T]) -> "Future[T]":
        """Run a job in the thread, between two batches; it fails once the thread is closed."""
        future: Future[T] = Future()

        def run() -> None:
            try:
                if self._closing:
                    raise RuntimeError("the live pipeline is closed")
                future.set_result(job())
            except BaseException as error:  # noqa: BLE001 - the waiter gets it
                future.set_exception(error)

        self._jobs.put(run)
        self._wake.set()
        if self._closing and not self._thread.is_alive():
            self._run_jobs()
        return future

    def add(self, name: str, worker: Callable[[], bool | None]) -> None:
        """Register a worker; call in the thread, by ``submit``."""
        self._workers[name] = worker

    def remove(self, name: str) -> None:
        """Remove a worker; call in the thread, by ``submit``."""
        self._workers.pop(name, None)

    def close(self) -> None:
        """End the thread after the batch in hand."""
        self._closing = True
        self._wake.set()
        self._thread.join(10.0)

    def _run(self) -> None:
        later = False
        while not self._closing:
            self._wake.wait(_LATER_S if later else None)
            # Cleared before the work is looked at: what comes meanwhile wakes the next round.
            self._wake.clear()
            busy = True
            while busy and not self._closing:
                self._waits = True
                with self._turn:
                    self._waits = False
                    if self._closing:
                        break
                    busy, later = self._round()
                    self._since_s = None
        self._run_jobs()

    def _round(self) -> tuple[bool, bool]:
        """Run all jobs, and each worker once.

        Returns:
            Whether any worker did something, and whether any has to be called again soon.
        """
        busy = later = False
        self._run_jobs()
        for name, worker in list(self._workers.items()):
            if self._workers.get(name) is not worker:
                continue  # a job has removed it meanwhile
            done = self._call(name, worker)
            busy, later = bool(done) or busy, done is None or later
            # A start or stop waits for one device's batch, not for a round of all.
            self._run_jobs()
        return busy, later

    def _call(self, name: str, worker: Callable[[], bool | None]) -> bool | None:
        """Call a worker; one that fails is removed."""
        self._since_s = time.monotonic()
        try:
            return worker()
        except Exception:  # noqa: BLE001
            # A worker reports its own failure; this is the last line of defence.
            _log.exception("worker %s failed and is removed", name)
            self.remove(name)
            return False

    def _run_jobs(self) -> None:
        with suppress(Empty):
            while True:
                job = self._jobs.get_nowait()
                self._since_s = time.monotonic()
                job()


def call_in_loop(
    loop: asyncio.AbstractEventLoop, call: Callable[..., object], *args: object
) -> None:
    """Call in an event loop, from any thread; nothing happens in one that has ended."""
    with suppress(RuntimeError):  # it is closed: the service is ending
        if asyncio._get_running_loop() is loop:
            # It is awake already.
            loop.call_soon(call, *args)
        else:
            loop.call_soon_threadsafe(call, *args)


@cache
def limit_blas_threads() -> None:
    """Let BLAS use the calling thread alone, in the whole process, from now on.

    For a triangle of four by four its own threads wait for each other for milliseconds when the
    cores are busy; for the few hundred unknowns of a calibration they gain next to nothing.
    """
    # What is not loaded yet cannot be told: NumPy and SciPy have a BLAS each.
    import scipy.linalg  # noqa: F401
    from threadpoolctl import threadpool_limits

    threadpool_limits(limits=1, user_api="blas")
