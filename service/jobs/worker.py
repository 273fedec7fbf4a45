"""Main functions of worker processes: call functions and report through a pipe.

Imports nothing heavy itself: what is set for the numerical libraries must be set before they are
loaded, with the task or by ``preloaded``.
"""

import contextlib
import os
import pathlib
import pickle
import signal
import traceback
from dataclasses import dataclass
from multiprocessing import parent_process
from multiprocessing.connection import Connection, wait
from threading import Thread
from typing import Any, Final

THREAD_VARIABLES: Final = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
)
"""Environment variables that tell numerical libraries, before they are loaded, their threads."""
_NICENESS: Final = 10


@dataclass(frozen=True)
class Progress:
    """Progress of the task: share done, 0 .. 1, and the stage."""

    share: float
    stage: str


@dataclass(frozen=True)
class Done:
    """The task's result."""

    result: Any


@dataclass(frozen=True)
class Failed:
    """The task ended by an error.

    Args:
        code: of the LumilineError; None for any other exception.
        detail: what it says; of any other exception the traceback, for the log only.
        context: the error's values by name.
    """

    code: str | None
    detail: str
    context: dict[str, Any]


Message = Progress | Done | Failed


def work(connection: Connection, task: bytes, memory_bytes: int | None) -> None:
    """Run a pickled ``(function, arguments)`` and send what comes of it; the process's target.

    The function gets a callable ``(share, stage)`` as its first argument.
    """
    _prepare(memory_bytes)

    def report_progress(share: float, stage: str) -> None:
        connection.send(Progress(share, stage))

    message = _outcome(task, report_progress)
    with contextlib.suppress(BrokenPipeError):
        connection.send(message)
    connection.close()


def serve(connection: Connection, memory_bytes: int, idle_s: float, peak_bytes: int) -> None:
    """Run one pickled ``(function, arguments)`` after another; the target of a ``CallProcess``.

    Args:
        connection: brings the tasks, each with the time for which it may compute [s], after which
            the process is ended by SIGPROF; takes what comes of them.
        memory_bytes: most memory that the process may take.
        idle_s: how long it waits for the next task before it ends.
        peak_bytes: it ends after a task that took more memory, which goes back to the system.
    """
    _prepare(memory_bytes)
    with contextlib.suppress(BrokenPipeError, EOFError):
        while connection.poll(idle_s):
            task, computing_s = connection.recv()
            _limit_computing(computing_s)
            connection.send(_outcome(task))
            _limit_computing(0.0)
            if _peak_memory_bytes() > peak_bytes:
                break
    connection.close()


def _prepare(memory_bytes: int | None) -> None:
    """Make this process a worker: polite, of one thread, bounded, ending with its parent."""
    # Ctrl-C, and its end, go to all processes of a terminal; the parent decides what becomes of
    # this one.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # what it was forked from ignores it
    if hasattr(signal, "SIGHUP"):
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
    Thread(target=_end_with_parent, daemon=True).start()
    for name in THREAD_VARIABLES:
        os.environ[name] = "1"
    with contextlib.suppress(OSError):
        os.nice(_NICENESS)  # live devices go first
    if memory_bytes is not None:
        _limit_memory(memory_bytes)


def _outcome(task: bytes, *before: Any) -> Message:
    """Run a task with ``before`` as its first arguments."""
    from compute.errors import LumilineError

    try:
        function, arguments = pickle.loads(task)  # noqa: S301 - from our own parent process
        return Done(function(*before, *arguments))
    except MemoryError:
        return Failed(None, "the worker's memory is used up", {})
    except LumilineError as error:
        return Failed(error.code, error.detail, error.context)
    except Exception:  # noqa: BLE001 - the parent decides what to tell
        return Failed(None, traceback.format_exc(), {})


def _peak_memory_bytes() -> int:
    """Return the peak memory of this process [bytes]; 0 where the system does not report it.

    Not ``ru_maxrss``, which begins with that of the process that started this one.
    """
    try:
        with pathlib.Path("/proc/self/status").open(encoding="ascii") as file:
            return next(1024 * int(line.split()[1]) for line in file if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        return 0


def _limit_memory(limit_bytes: int) -> None:
    """Limit further memory allocation, beyond that of the libraries; POSIX only."""
    try:
        import resource
    except ImportError:
        return
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    if hard == resource.RLIM_INFINITY or hard > limit_bytes:
        resource.setrlimit(resource.RLIMIT_DATA, (limit_bytes, hard))


def _limit_computing(limit_s: float) -> None:
    """Let SIGPROF end this process when it has computed for so long; 0: no limit. POSIX only."""
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_PROF, limit_s)


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
