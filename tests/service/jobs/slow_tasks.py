"""Functions that runs of the tests compute, in real processes."""

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from compute.errors import NoConvergence

Progress = Callable[[float, str], None]


def wait_for_end(report_progress: Progress, pid_file: str) -> None:
    """Never end by itself; says which process it is in."""
    Path(pid_file).write_text(str(os.getpid()))
    report_progress(0.25, "waits")
    while True:
        time.sleep(0.01)


def wait_for_file(report_progress: Progress, path: str) -> str:
    """End when a file is there."""
    report_progress(0.5, "waits")
    while not Path(path).exists():
        time.sleep(0.01)
    return "done"


def fail(report_progress: Progress) -> None:
    raise NoConvergence("it ran away", sensor="left")


def break_down(report_progress: Progress) -> None:
    raise RuntimeError("a secret path")


def die(report_progress: Progress) -> None:
    os._exit(7)


def end_by_sigterm(report_progress: Progress) -> None:
    signal.raise_signal(signal.SIGTERM)


def take_memory(report_progress: Progress) -> int:
    return len(bytearray(10**10))


def settings_of_process(report_progress: Progress) -> dict[str, Any]:
    return {"niceness": os.nice(0), "threads": os.environ["OPENBLAS_NUM_THREADS"]}


def parent_of_process(report_progress: Progress) -> int:
    return os.getppid()
