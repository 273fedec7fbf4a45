"""RecordingProcess: works out, in a process of its own, what requests want of recordings."""

from collections.abc import Callable
from typing import Any, Final

from service.api.concurrency_limit import ConcurrencyLimit
from service.jobs.call_process import CallProcess

TIMEOUT_S: Final = 60.0
"""For a request; the first one starts the process and loads its kernels, in seconds."""
MEMORY_BYTES: Final = 4 * 2**30
PEAK_BYTES: Final = 2**30
MAX_CONCURRENT: Final = 4


class RecordingProcess:
    """Calls functions for requests that wait, a few at most.

    In a process: frames with many markers lit together take long, and would keep the live pipeline
    waiting. It is started when needed, keeps its kernels, and ends when idle.

    Args:
        wanted: what the requests wait for, in the plural.
    """

    def __init__(self, wanted: str) -> None:
        self._process = CallProcess(MEMORY_BYTES, PEAK_BYTES)
        self._limit = ConcurrencyLimit(
            MAX_CONCURRENT,
            f"{MAX_CONCURRENT} requests wait for {wanted} of recordings; send this one "
            "again in a second",
        )

    def call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return ``function(*arguments)``, as ``CallProcess.call`` does.

        Args:
            function: importable by its name.
            arguments: what can be pickled.

        Raises:
            Busy: too many such requests wait.
            WorkerEnded: it took too much time or memory, or the server ends.
            LumilineError: what the function raised.
        """
        with self._limit:
            return self._process.call(function, *arguments, timeout_s=TIMEOUT_S)

    def close(self) -> None:
        """End the process."""
        self._process.close()
