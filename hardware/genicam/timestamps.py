"""Timestamps and frame numbers of a camera, continued over resets and reconnections."""

import time
from typing import Final

from hardware.clock_sync import DeviceClock, host_clock_offset_ns

_PER_S: Final = 1_000_000_000


class ScanTimestamps:
    """Converts buffer timestamps to device and host times of scans.

    Host times are those of the monotonic clock, which adjustments of the host's clock do not
    change. Device and host times rise strictly. Host times are late by the shortest delay of
    the link beyond the exposure, the time to send a buffer; see ``DeviceClock``.

    Args:
        exposure_ns: shortest time between a buffer's timestamp and its arrival [ns].
    """

    def __init__(self, exposure_ns: int = 0) -> None:
        self._clock = DeviceClock(_PER_S, delay_ns=exposure_ns)
        self._buffer_ns = (0, 0)
        self._device_ns = -1
        self._monotonic_ns = 0

    @property
    def restarts(self) -> int:
        """Number of resets of the camera's clock."""
        return self._clock.restarts

    @property
    def uncertainty_ns(self) -> float:
        """Standard deviation of host times, beyond the shortest delay [ns]; inf at first."""
        return self._clock.uncertainty_ns

    def buffer(self, camera_ns: int, arrival_ns: int) -> None:
        """Add a buffer: its time on the camera's clock and its monotonic arrival time [ns]."""
        stamp = self._clock.stamp(camera_ns, arrival_ns)
        self._buffer_ns = stamp.device_ns, stamp.host_ns

    def line(self, after_ns: int) -> tuple[int, int]:
        """Return device and monotonic time [ns] of a scan ``after_ns`` after the buffer's time."""
        device_ns, monotonic_ns = self._buffer_ns
        self._device_ns = max(device_ns + after_ns, self._device_ns + 1)
        self._monotonic_ns = max(monotonic_ns + after_ns, self._monotonic_ns + 1)
        return self._device_ns, self._monotonic_ns


class BufferTimestamps:
    """Converts arrival times from the wall clock to the monotonic clock.

    Aravis states arrivals on the wall clock, which may be adjusted. A buffer arrived after its
    stream was last found empty and before it is taken, which bounds the error.
    """

    def __init__(self) -> None:
        self._empty_ns = time.monotonic_ns()

    def empty(self, monotonic_ns: int) -> None:
        """Record a monotonic time at which the stream was empty [ns]."""
        self._empty_ns = monotonic_ns

    def of(self, wall_ns: int) -> int:
        """Return the monotonic time of an arrival from its wall-clock time [ns]."""
        arrival_ns = wall_ns - host_clock_offset_ns()
        return min(max(arrival_ns, self._empty_ns), time.monotonic_ns())


_LAST_16_BIT: Final = 65535
_NEAR: Final = 32768


class FrameCounter:
    """Unwraps frame numbers of a camera to a count since the driver was opened.

    GigE Vision's 16-bit numbers wrap from 65535 to 1; extended ones have 64 bits. Any other
    decrease means that the camera was reset.
    """

    def __init__(self) -> None:
        self.lost = 0
        """Number of missing frames."""
        self.restarts = 0
        """Number of resets; the number of exposures lost then is unknown."""
        self._last: int | None = None
        self._count = -1

    def next(self, number: int) -> int:
        """Return the unwrapped count of the frame with this number; it always increases."""
        step = 1 if self._last is None else _step(self._last, number)
        if step is None:
            self.restarts += 1
            step = 1
        self._last = number
        self._count += step
        self.lost += step - 1
        return self._count

    def restart(self) -> None:
        """Accept any next number: the camera was lost meanwhile."""
        self._last = None
        self.restarts += 1


def _step(last: int, number: int) -> int | None:
    """Return the increment between two frame numbers; None: the camera was reset."""
    if number > last:
        return number - last
    wrapped = number + _LAST_16_BIT - last
    if last <= _LAST_16_BIT and 0 < wrapped < _NEAR and number > 0:
        return wrapped
    return None
