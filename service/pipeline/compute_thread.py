"""ComputeThread: the one thread that owns Warp and processes the frames of all devices."""

import logging
import time
from collections.abc import Callable
from concurrent.futures import Future
from functools import cache
from queue import Empty, SimpleQueue
from threading import Event, Thread
from typing import TypeVar

_log = logging.getLogger(__name__)

T = TypeVar("T")


class ComputeThread:
    """Calls every registered worker whenever frames wait, and jobs that need this thread.

    A worker takes what is there and returns whether it did anything; the thread sleeps when
    none of them did and no frame has come since.
    """

    def __init__(self) -> None:
        self._wake = Event()
        self._jobs: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._workers: dict[str, Callable[[], bool]] = {}
        self._closing = False
        self._since_s: float | None = None
        self._thread = Thread(target=self._run, name="compute", daemon=True)

    def start(self) -> None:
        """Start the thread."""
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

    def add(self, name: str, worker: Callable[[], bool]) -> None:
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
        while not self._closing:
            self._since_s = None
            self._wake.wait()
            # Cleared before the work is looked at: what comes meanwhile wakes the next round.
            self._wake.clear()
            busy = True
            while busy and not self._closing:
                busy = False
                self._run_jobs()
                for name, worker in list(self._workers.items()):
                    self._since_s = time.monotonic()
                    try:
                        busy = worker() or busy
                    except Exception:  # noqa: BLE001
                        # A worker reports its own failure; this is the last line of defence.
                        _log.exception("worker %s failed and is removed", name)
                        self.remove(name)
                    # A start or stop waits for one device's batch, not for a round of all.
                    self._run_jobs()
        self._run_jobs()

    def _run_jobs(self) -> None:
        while True:
            try:
                job = self._jobs.get_nowait()
            except Empty:
                return
            self._since_s = time.monotonic()
            job()


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
