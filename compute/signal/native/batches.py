"""What a batch of lines may be, and the threads that share it on the CPU."""

import os
from concurrent.futures import ThreadPoolExecutor
from functools import cache

from compute.errors import InvalidParameter
from compute.signal.settings import MAX_PIXELS, MIN_PIXELS


@cache
def helpers() -> ThreadPoolExecutor:
    """Return the threads that help the caller's: one for each further CPU."""
    return ThreadPoolExecutor(max(cpus() - 1, 1), thread_name_prefix="lines")


@cache
def cpus() -> int:
    """Return the number of CPUs that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def check_threads(threads: int | None) -> int:
    """Return how many threads share a batch; None: as many as there are CPUs.

    Raises:
        InvalidParameter: fewer than one.
    """
    if threads is None:
        return cpus()
    if threads < 1:
        raise InvalidParameter(f"threads is {threads}; it must be 1 or more", threads=threads)
    return threads


def check_size(lines: int, pixels: int) -> None:
    """Refuse batches that no kernel takes.

    Raises:
        InvalidParameter: fewer than one line, or lines that are too short or too long.
    """
    if lines < 1:
        raise InvalidParameter(f"lines is {lines}; it must be 1 or more", lines=lines)
    if not MIN_PIXELS <= pixels <= MAX_PIXELS:
        raise InvalidParameter(
            f"a line has {pixels} pixels; it must have {MIN_PIXELS} to {MAX_PIXELS}",
            pixels=pixels,
        )
