"""Times of a camera's lines: on its own clock, which goes on over restarts, and the host's."""

import time
from typing import Final

from hardware.clock_sync import DeviceClock

_PER_S: Final = 1_000_000_000


class ScanTimestamps:
    """Turns the times of a camera's buffers into device and host times of lines.

    Host times are those of the monotonic clock: a host's clock that is set, forward or back,
    changes nothing here. Neither device nor host times go back. Host times are later than true by
    the least delay of the way beyond the exposure, which is what the camera takes to send a
    buffer; see ``DeviceClock``.

    Args:
        exposure_ns: what passes at least between a buffer's time and its arrival [ns].
    """

    def __init__(self, exposure_ns: int = 0) -> None:
        self._clock = DeviceClock(_PER_S, delay_ns=exposure_ns)
        self._buffer_ns = (0, 0)
        self._device_ns = -1
        self._monotonic_ns = 0

    @property
    def restarts(self) -> int:
        """How often the camera's clock began anew."""
        return self._clock.restarts

    def buffer(self, camera_ns: int, arrival_ns: int) -> None:
        """Take a buffer's time on the camera's clock, and its arrival on the monotonic one [ns]."""
        stamp = self._clock.stamp(camera_ns, arrival_ns)
        self._buffer_ns = stamp.device_ns, stamp.host_ns

    def line(self, after_ns: int) -> tuple[int, int]:
        """Return device and monotonic time [ns] of what was so long after the buffer's time."""
        device_ns, monotonic_ns = self._buffer_ns
        self._device_ns = max(device_ns + after_ns, self._device_ns + 1)
        self._monotonic_ns = max(monotonic_ns + after_ns, self._monotonic_ns)
        return self._device_ns, self._monotonic_ns


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


_LAST_16_BIT: Final = 65535
_NEAR: Final = 32768


class FrameCounter:
    """Frame numbers of a camera, as exposures since the driver was opened.

    GigE Vision's 16-bit numbers go from 65535 to 1; extended ones have 64 bits. A number that
    goes back otherwise is that of a camera which began anew.
    """

    def __init__(self) -> None:
        self.lost = 0
        """Numbers that were left out."""
        self.restarts = 0
        """How often the numbers began anew; how many exposures were lost then, nobody knows."""
        self._last: int | None = None
        self._count = -1

    def next(self, number: int) -> int:
        """Return the count of the frame with this number, larger than the last one."""
        step = 1 if self._last is None else _step(self._last, number)
        if step is None:
            self.restarts += 1
            step = 1
        self._last = number
        self._count += step
        self.lost += step - 1
        return self._count

    def restart(self) -> None:
        """Take the next number as it is: the camera was lost meanwhile."""
        self._last = None
        self.restarts += 1


def _step(last: int, number: int) -> int | None:
    """Return how many exposures later; None: the camera began anew."""
    if number > last:
        return number - last
    wrapped = number + _LAST_16_BIT - last
    if last <= _LAST_16_BIT and 0 < wrapped < _NEAR and number > 0:
        return wrapped
    return None
