"""CallProcess: a process that is kept and answers one call after another, with bounds."""

import pickle
import signal
from collections.abc import Callable
from threading import Lock
from typing import TYPE_CHECKING, Any, Final

from service.jobs.worker import Done, Failed, Message, serve
from service.jobs.worker_process import process_context
from service.problems.catalogue import ERRORS
from service.problems.errors import WorkerEnded

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from multiprocessing.process import BaseProcess

_JOIN_S: Final = 5.0
_IDLE_S: Final = 60.0
_WAIT_FACTOR: Final = 10.0
"""How much longer than its computing time a call may take: the process is nice, and on a busy
machine gets a small share."""
_CLOSED: Final = "the server stops; send this again when it is up again"


class CallProcess:
    """Calls functions in a process, which is started when needed and ends when idle.

    For what would hold the interpreter's lock, and with it all else, for long: starting a process
    for each call would take longer than the call.

    Args:
        memory_bytes: most memory that the process may take.
        peak_bytes: the process ends after a call that took more, and gives it back.
        idle_s: how long it waits for another call before it ends.
    """

    def __init__(self, memory_bytes: int, peak_bytes: int, idle_s: float = _IDLE_S) -> None:
        self._bounds = (memory_bytes, idle_s, peak_bytes)
        self._lock = Lock()
        self._closed = False
        self._process: BaseProcess | None = None
        self._pipe: Connection[Any, Any] | None = None

    def call(self, function: Callable[..., Any], *arguments: Any, timeout_s: float) -> Any:
        """Return ``function(*arguments)``; calls of several threads follow each other.

        Args:
            function: importable by its name.
            arguments: what can be pickled.
            timeout_s: time for which the process may compute; it may take ten times as long in
                all, since other processes go first.

        Raises:
            WorkerEnded: the process crashed, took too long or too much memory, or was closed.
            LumilineError: what the function raised.
            RuntimeError: it failed otherwise.
        """
        task = pickle.dumps((function, arguments))
        with self._lock:
            message = self._exchange(task, timeout_s)
        if isinstance(message, Done):
            return message.result
        assert isinstance(message, Failed)
        if message.code is None:
            raise RuntimeError(message.detail)
        raise ERRORS[message.code](message.detail, **message.context)

    @property
    def closed(self) -> bool:
        """Whether it was closed: calls fail for that reason, and for no other."""
        return self._closed

    def close(self) -> None:
        """End the process at once; a call in progress, and all later ones, raise WorkerEnded."""
        self._closed = True
        if self._lock.acquire(blocking=False):
            try:
                self._end(wait_s=0.0)
            finally:
                self._lock.release()
        elif (process := self._process) is not None:
            process.kill()  # the call that has the lock sees its end, or before that _closed

    def _exchange(self, task: bytes, timeout_s: float) -> Message:
        running = self._pipe is not None
        try:
            return self._ask(task, timeout_s)
        except (EOFError, OSError) as error:
            code = self._end()
            if self._closed:
                raise WorkerEnded(_CLOSED) from error
            if code == -getattr(signal, "SIGPROF", 0):
                raise WorkerEnded(
                    f"it computed for longer than {timeout_s:g} s and was ended",
                    timeout_s=timeout_s,
                ) from error
            if not running:
                raise WorkerEnded("the process that computed ended without a result") from error
        return self._exchange(task, timeout_s)  # the one that was kept had been idle for too long

    def _ask(self, task: bytes, timeout_s: float) -> Message:
        if self._pipe is None and not self._closed:
            self._start()
        if self._closed:  # while it was started, too
            self._end(wait_s=0.0)
            raise WorkerEnded(_CLOSED)
        assert self._pipe is not None
        self._pipe.send((task, timeout_s))
        longest_s = _WAIT_FACTOR * timeout_s
        if not self._pipe.poll(longest_s):
            self._end(wait_s=0.0)
            raise WorkerEnded(
                f"it took longer than {longest_s:g} s and was ended", timeout_s=longest_s
            )
        message: Message = self._pipe.recv()
        return message

    def _start(self) -> None:
        context = process_context()
        ours, theirs = context.Pipe()
        with theirs:
            process = context.Process(
                target=serve, args=(theirs, *self._bounds), name="lumiline-calls", daemon=True
            )
            process.start()
        self._pipe, self._process = ours, process

    def _end(self, wait_s: float = _JOIN_S) -> int | None:
        """End the process, which may be about to end by itself; return its exit code."""
        code = None
        if self._process is not None:
            self._process.join(wait_s)
            code = self._process.exitcode
            self._process.kill()
            self._process.join(_JOIN_S)
            self._process = None
        if self._pipe is not None:
            self._pipe.close()
            self._pipe = None
        return code
