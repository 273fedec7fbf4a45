"""Times of a camera's lines: on its own clock, which goes on over restarts, and the host's."""

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
