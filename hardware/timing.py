"""Pacing: waits until a monotonic time, and converts monotonic times to host times."""

import time
from threading import Event


def wait_until(due_ns: int, closed: Event) -> None:
    """Wait until a time of the monotonic clock [ns]; return at once when the event is set."""
    left_ns = due_ns - time.monotonic_ns()
    if left_ns > 0:
        closed.wait(left_ns * 1e-9)


def host_time_ns(monotonic_ns: int) -> int:
    """Convert a time of the monotonic clock to the clock of time.time_ns() [ns].

    Read again for each frame, because the host's clock may have been set meanwhile.
    """
    return time.time_ns() + monotonic_ns - time.monotonic_ns()
