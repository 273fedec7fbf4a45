"""When buffers came, on the clock that nobody sets: Aravis says it on the one that is set."""

import time


class BufferTimestamps:
    """Brings times of time.time_ns() to time.monotonic_ns(), within what is known of them.

    A buffer came after its stream was last found empty, and before it is taken. Where the host's
    clock was set between its arrival and its taking, it is off by no more than that.
    """

    def __init__(self) -> None:
        self._empty_ns = time.monotonic_ns()

    def empty(self, monotonic_ns: int) -> None:
        """Note that nothing had come by then [ns]."""
        self._empty_ns = monotonic_ns

    def of(self, wall_ns: int) -> int:
        """Return the monotonic time [ns] of an arrival at that time of the host's clock."""
        now_ns = time.monotonic_ns()
        age_ns = time.time_ns() - wall_ns
        return min(max(now_ns - age_ns, self._empty_ns), now_ns)
