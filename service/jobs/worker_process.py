"""WorkerProcess: handle of a process that runs one function."""

import multiprocessing
import pickle
import sys
import time
from collections.abc import Callable
from functools import cache
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Self

from service.jobs.worker import Done, Failed, Message, Progress, work
from service.problems.catalogue import ERRORS
from service.problems.errors import WorkerEnded

if TYPE_CHECKING:
    from multiprocessing.context import ForkServerContext, SpawnContext

_JOIN_S: Final = 5.0


@cache
def process_context() -> "ForkServerContext | SpawnContext":
    """Return what worker processes are made with.

    They are forked from a process that has loaded what they need, which takes a second, and has one
    thread: a fork of the server would copy locks that its other threads hold.
    """
    safe = sys.version_info >= (3, 11, 1)  # CVE-2022-42919: other users could reach what forks
    if not safe or "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["service.jobs.preloaded"])
    return context


class WorkerProcess:
    """Runs ``function(tell, *arguments)`` in a process of its own, which ends with this one."""

    def __init__(
        self,
        function: Callable[..., Any],
        *arguments: Any,
        memory_bytes: int | None = None,
    ) -> None:
        """Start it.

        Args:
            function: importable by its name; ``tell(share, stage)`` is its first argument.
            arguments: what can be pickled.
            memory_bytes: most memory that the process may take; None: no limit.
        """
        context = process_context()
        self._pipe, theirs = context.Pipe(duplex=False)
        task = pickle.dumps((function, arguments))
        with theirs:
            self._process = context.Process(
                target=work, args=(theirs, task, memory_bytes), name="lumiline-worker", daemon=True
            )
            self._process.start()

    @property
    def pid(self) -> int | None:
        """The process's id."""
        return self._process.pid

    def next(self, wait_s: float) -> Progress | Done | None:
        """Return the next message; None: none came within this time.

        Raises:
            WorkerEnded: it ended without a result.
            LumilineError: what the function raised.
            RuntimeError: it failed otherwise.
        """
        try:
            if not self._pipe.poll(wait_s):
                return None
            message: Message = self._pipe.recv()
        except (EOFError, OSError):
            self._process.join(_JOIN_S)
            code = self._process.exitcode
            raise WorkerEnded(
                f"the process that computed ended without a result (exit code {code}); -9 is "
                "what the system does to a process that takes too much memory",
                exit_code=code,
            ) from None
        if isinstance(message, Failed):
            if message.code is None:
                raise RuntimeError(message.detail)
            raise ERRORS[message.code](message.detail, **message.context)
        return message

    def kill(self) -> None:
        """End it at once, in whatever state it is; nothing happens when it has ended."""
        if self._process.is_alive():
            self._process.kill()
        self._process.join(_JOIN_S)
        self._pipe.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.kill()


def call_in_process(
    function: Callable[..., Any], *arguments: Any, timeout_s: float, memory_bytes: int
) -> Any:
    """Return ``function(tell, *arguments)``, computed in a process with bounds.

    For what a library makes of data that nobody has looked at: a crash there costs an answer and
    not the server.

    Raises:
        WorkerEnded: it crashed, took too long or too much memory.
        LumilineError: what the function raised.
        RuntimeError: it failed otherwise.
    """
    end = time.monotonic() + timeout_s
    with WorkerProcess(function, *arguments, memory_bytes=memory_bytes) as worker:
        while True:
            message = worker.next(max(0.0, end - time.monotonic()))
            if isinstance(message, Done):
                return message.result
            if message is None:
                raise WorkerEnded(
                    f"it took longer than {timeout_s:g} s and was ended", timeout_s=timeout_s
                )
