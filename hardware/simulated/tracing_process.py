"""Traces the optics of simulated devices in a process of its own.

Tracing is ten seconds of small steps in the interpreter: in a thread beside running devices each
step waits for theirs, and theirs for it, which took minutes and cost frames.
"""

import os
import pickle
import subprocess
import sys
import time
from contextlib import suppress
from threading import Event
from typing import Final

from compute.optics.stripe_optics.stripe_table import StripeTable
from compute.optics.stripe_optics.tabulated_optics import TableRequest, make_table

TIMEOUT_S: Final = 600.0
_POLL_S: Final = 0.1
_NICENESS: Final = 10
_MODULE: Final = "hardware.simulated.tracing_process"


class TracingCancelled(Exception):
    """The device was closed while its optics were traced."""


def table_in_process(request: TableRequest, cancelled: Event) -> StripeTable:
    """Return a traced table.

    Args:
        request: what is traced.
        cancelled: ends it when set, from any thread.

    Raises:
        TracingCancelled: it was.
        RuntimeError: the process failed or took too long.
    """
    process = subprocess.Popen(  # noqa: S603 - our own command line
        [sys.executable, "-m", _MODULE],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
    )
    end = time.monotonic() + TIMEOUT_S
    given: bytes | None = pickle.dumps(request)
    with process:
        try:
            while True:
                try:
                    answer, _ = process.communicate(given, timeout=_POLL_S)
                    break
                except subprocess.TimeoutExpired:
                    given = None  # it is being sent
                if cancelled.is_set():
                    raise TracingCancelled
                if time.monotonic() > end:
                    raise RuntimeError(f"tracing took longer than {TIMEOUT_S:g} s and was ended")
        finally:
            process.kill()
    if process.returncode != 0:
        raise RuntimeError(f"the process that traced ended with {process.returncode}")
    table: StripeTable = pickle.loads(answer)  # noqa: S301 - from our own child process
    return table


def main() -> None:
    """Answer one request of the standard input on the standard output."""
    with suppress(AttributeError, OSError):
        # A station that runs in real time passes that on.
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    os.nice(_NICENESS)
    request = pickle.loads(sys.stdin.buffer.read())  # noqa: S301 - from our own parent process
    # Whatever a library prints must not be taken for the answer.
    with os.fdopen(os.dup(1), "wb") as answer:
        os.dup2(2, 1)
        answer.write(pickle.dumps(make_table(request)))


if __name__ == "__main__":
    main()
