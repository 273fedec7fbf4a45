"""RunManager: takes queued runs, computes each in a process and stores its result."""

import logging
import secrets
import signal
import time
from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from threading import Event, Lock, Thread
from typing import Any, Final, TypeVar

from sqlalchemy.orm import Session

from compute.errors import LumilineError
from service.database.engine import Database
from service.database.gateway import Gateway
from service.database.models import RunRow
from service.jobs import store
from service.jobs.worker import Done, Progress
from service.jobs.worker_process import WorkerProcess
from service.principal import Act, current_act
from service.problems.bounds import DETAIL_CHARACTERS, bound_context, cut_text
from service.problems.catalogue import PROBLEM_TYPES
from service.problems.errors import NotReady, WorkerEnded

BOUNDS_S: Final = (0.5, 1.0, 2.0, 5.0, 10.0, 30.0, 60.0, 300.0, 1800.0, 7200.0)
"""Upper bounds of the classes [s]; one more, without a bound, follows."""


class DurationHistogram:
    """Counts of each kind of run and how it ended; all methods may be called from any thread."""

    def __init__(self) -> None:
        self._counts: dict[tuple[str, ...], tuple[list[int], float]] = {}
        self._lock = Lock()

    def ended(self, row: RunRow) -> None:
        """Count a run that has ended."""
        if row.started_at is None or row.finished_at is None:
            return
        seconds = max((row.finished_at - row.started_at).total_seconds(), 0.0)
        key = (row.kind, row.state)
        with self._lock:
            counts, total = self._counts.get(key, ([0] * (len(BOUNDS_S) + 1), 0.0))
            counts[bisect_left(BOUNDS_S, seconds)] += 1
            self._counts[key] = counts, total + seconds

    def counts(self) -> dict[tuple[str, ...], tuple[tuple[int, ...], float]]:
        """Return by kind and state the counts of all classes, and the sum [s]."""
        with self._lock:
            return {key: (tuple(counts), total) for key, (counts, total) in self._counts.items()}


Task = tuple[Callable[..., Any], tuple[Any, ...]]


@dataclass(frozen=True)
class RunKind:
    """One kind of run.

    Args:
        task: returns the function to call in the process and its arguments, from a run's row.
        store: stores its result and returns the id under which it is found.
        results: path of the resource that the results are of.
        ended: called with the id of a run that has ended in any way, whatever was stored.
    """

    task: Callable[[Session, RunRow], Task]
    store: Callable[[Session, RunRow, Any], str]
    results: str
    ended: Callable[[str], None] = lambda _: None


_log = logging.getLogger(__name__)

_LOOK_S: Final = 5.0
"""How often it looks for runs that other servers have put down or lost."""
_POLL_S: Final = 0.1
_TELL_S: Final = 0.5
"""Progress is written to the database no more often."""
_HEARTBEAT_S: Final = 2.0
"""How often it looks, beside progress, whether the run was cancelled or deleted elsewhere."""
_RETRY_S: Final = 1.0
_STOP_S: Final = 30.0
"""How long a worker that was ended by SIGTERM keeps its place: the server's end takes no longer."""
_STOPPED: Final = "the server was stopped; post it again"

T = TypeVar("T")


class RunManager:
    """Runs at most ``at_once`` computations, each in a process of its own."""

    def __init__(
        self,
        database: Database,
        max_concurrent: int,
        kinds: Mapping[str, RunKind],
        gateway: Gateway | None = None,
    ) -> None:
        self._database = database
        self._gateway = Gateway() if gateway is None else gateway
        self._max_concurrent = max_concurrent
        self._kinds = kinds
        self._wake = Event()
        self._closing = Event()
        self._lock = Lock()
        self._running: dict[str, Thread] = {}
        self._cancelled: set[str] = set()
        self.durations = DurationHistogram()
        """Of the runs that came to their end here."""
        self._dispatcher = Thread(target=self._dispatch, name="runs", daemon=True)

    def start(self) -> None:
        """End what an earlier process of this server left, and begin to take runs."""
        with self._database.write() as session:
            for run_id in store.interrupt_lost(session, self._gateway, starting=True):
                _log.warning("run %s was interrupted by the end of the server before", run_id)
        self._dispatcher.start()

    @property
    def alive(self) -> bool:
        """Whether runs are taken."""
        return self._dispatcher.is_alive()

    def submitted(self) -> None:
        """Say that a run waits, or that another server ended; callable from any thread."""
        self._wake.set()

    def cancelled(self, run_id: str) -> None:
        """Say that a run was cancelled in the database, so that its process ends at once."""
        with self._lock:
            if run_id in self._running:
                self._cancelled.add(run_id)

    def close(self) -> None:
        """End the processes; their runs are interrupted, those that wait go on waiting."""
        self._closing.set()
        self._wake.set()
        if self._dispatcher.is_alive():
            self._dispatcher.join()
        with self._lock:
            threads = list(self._running.values())
        for thread in threads:
            thread.join()

    def _dispatch(self) -> None:
        while not self._closing.is_set():
            try:
                with self._lock:
                    computing = list(self._running)
                with self._database.write() as session:
                    # Its own are stale, too, after a suspend or an outage of the database.
                    lost = store.interrupt_lost(session, self._gateway, computing)
                for run_id in lost:
                    _log.warning("run %s was interrupted by the end of its server", run_id)
                while self._free_slots() and not self._closing.is_set() and self._take():
                    pass
            except NotReady:
                pass  # logged there; the next round tries again
            except Exception:  # noqa: BLE001 - this thread must not end
                _log.exception("runs: looking for the next failed")
            self._wake.wait(_LOOK_S)
            self._wake.clear()

    def _free_slots(self) -> bool:
        with self._lock:
            return len(self._running) < self._max_concurrent

    def _take(self) -> bool:
        """Start the next run; return whether there was one."""
        with self._database.write() as session:
            row = store.claim(session, self._gateway)
            if row is None:
                return False
            run_id = row.id
        thread = Thread(target=self._supervise, args=(run_id,), name=f"run-{run_id}", daemon=True)
        with self._lock:
            self._running[run_id] = thread
        thread.start()
        return True

    def _supervise(self, run_id: str) -> None:
        try:
            self._execute(run_id)
        except LumilineError as error:
            if _is_stopped(error):
                self._end(run_id, "interrupted", _STOPPED)
                self._closing.wait(_STOP_S)  # or the next run would begin, to be interrupted too
            else:
                problem = _problem(error.code, error.detail, error.context)
                self._end(run_id, "failed", "failed", problem)
        except Exception as error:  # noqa: BLE001 - becomes the run's problem
            reference = secrets.token_hex(4)
            _log.error("run %s, reference %s: %s", run_id, reference, error, exc_info=error)
            detail = f"unexpected error; the server's log has it under reference {reference}"
            self._end(run_id, "failed", "failed", _problem("internal-error", detail, {}))
        finally:
            with self._lock:
                self._running.pop(run_id, None)
                self._cancelled.discard(run_id)
            self._wake.set()

    def _execute(self, run_id: str) -> None:
        """Start the process, store its progress and its result."""
        with self._database.read() as session:
            row = store.RUNS.get(session, run_id)
            kind = self._kinds[row.kind]
            function, arguments = kind.task(session, row)
        try:
            self._compute(run_id, kind, function, arguments)
        finally:
            kind.ended(run_id)

    def _compute(
        self, run_id: str, kind: RunKind, function: Callable[..., Any], arguments: tuple[Any, ...]
    ) -> None:
        reported_s = time.monotonic()
        latest: Progress | None = None
        with WorkerProcess(function, *arguments) as worker:
            while True:
                if self._closing.is_set():
                    self._end(run_id, "interrupted", _STOPPED)
                    return
                with self._lock:
                    if run_id in self._cancelled:
                        return
                message = worker.next(_POLL_S)
                if isinstance(message, Done):
                    break
                if message is not None:
                    latest = message
                now = time.monotonic()
                if now - reported_s >= (_TELL_S if latest else _HEARTBEAT_S):
                    if not self._report_progress(run_id, latest):
                        return
                    reported_s, latest = now, None
        stored = self._write_with_retry(lambda: self._store(run_id, kind.store, message.result))
        if stored:
            _log.info("run %s succeeded", run_id)

    def _report_progress(self, run_id: str, latest: Progress | None) -> bool:
        """Write progress down; return whether the run is to go on."""
        try:
            with self._database.write() as session:
                return store.report_progress(
                    session,
                    run_id,
                    self._gateway.id,
                    latest.share if latest else None,
                    latest.stage if latest else None,
                )
        except NotReady:
            return True  # a database that does not answer now need not cost an hour's work

    def _store(self, run_id: str, keep: Callable[[Any, RunRow, Any], str], result: Any) -> bool:
        """Store a result and end its run in one transaction, unless the run was ended."""
        with self._database.write() as session:
            row = store.is_still_owner(session, run_id, self._gateway.id)
            if row is None:
                return False
            with _acting_as_submitter(row):
                row.result_id = keep(session, row, result)
                session.flush()
            store.finish(row, "succeeded", "done")
            self.durations.ended(row)
        return True

    def _end(
        self,
        run_id: str,
        state: store.State,
        stage: str,
        problem: dict[str, Any] | None = None,
    ) -> None:
        def write() -> None:
            with self._database.write() as session:
                row = store.is_still_owner(session, run_id, self._gateway.id)
                if row is not None:
                    store.finish(row, state, stage, problem)
                    self.durations.ended(row)

        try:
            self._write_with_retry(write)
        except NotReady:
            # Nobody hears of it now; without its heartbeat the run is told as interrupted.
            _log.error("run %s: its end could not be written down", run_id)

    def _write_with_retry(self, write: Callable[[], T]) -> T:
        """Write to the database, again while it does not answer, until the server stops."""
        while True:
            try:
                return write()
            except NotReady:
                if self._closing.wait(_RETRY_S):
                    raise


def _is_stopped(error: LumilineError) -> bool:
    """Whether a worker was ended by SIGTERM, which goes to the server's other processes too."""
    return isinstance(error, WorkerEnded) and error.context.get("exit_code") == -signal.SIGTERM


@contextmanager
def _acting_as_submitter(row: RunRow) -> Iterator[None]:
    """Attribute database changes to the principal who posted the run."""
    act = None if row.poster is None else Act.of_stored(row.poster)
    token = current_act.set(act)
    try:
        yield
    finally:
        current_act.reset(token)


def _problem(code: str, detail: str, context: Mapping[str, object]) -> dict[str, Any]:
    """Return an error as the members of a problem document; the run's path is its instance."""
    kind = PROBLEM_TYPES[code]
    problem = kind.model_dump(include={"type", "title", "status"})
    problem["detail"] = cut_text(detail, DETAIL_CHARACTERS)
    if context:
        problem["context"] = bound_context(context)
    return problem
