"""Builds line frames from a device's exposures: continuous numbers, times on both clocks."""

from hardware.clock_sync import DeviceClock
from hardware.line_frame import FrameFlag, LineFrame
from hardware.serial.messages import NO_MARKER, Description, LinesFlag
from hardware.serial.reassembly import AssembledExposure
from hardware.timing import host_time_ns

_SEQUENCE_WRAP = 2**32


def _clock(description: Description) -> tuple[int, int, int]:
    delay_ns = round(description.delay_us * 1e3)
    return description.clock_hz, description.clock_bits, delay_ns


class FrameBuilder:
    """Builds the frames of one device across disconnections and resets.

    Args:
        device: the device's name.
        description: the device's description.
        markers: number of strobed markers; a frame of another marker is refused.

    Attributes:
        clock: maps the device's clock to the host's.
        built: number of frames built.
        lost: exposures missing in the device's sequence numbers.
        refused: exposures with an invalid marker.
    """

    def __init__(self, device: str, description: Description, markers: int) -> None:
        self.clock = DeviceClock(*_clock(description))
        self.built = 0
        self.lost = 0
        self.refused = 0
        self._device = device
        self._markers = markers
        self._last_number: int | None = None
        self._sequence = -1
        self._reconnected_description: Description | None = None

    def reconnect(self, description: Description) -> None:
        """Use the clock and delay of a new description from the next exposure on."""
        self._reconnected_description = description

    def build(self, exposed: AssembledExposure, arrival_ns: int) -> LineFrame | None:
        """Return the frame of an exposure that arrived at a monotonic time [ns].

        None: its marker is invalid.

        Raises:
            InvalidParameter: the clock of the reconnected device wraps too often.
        """
        marker = None if exposed.marker == NO_MARKER else exposed.marker
        if marker is not None and marker >= self._markers:
            self.refused += 1
            return None
        last = self._last_number
        step = 1 if last is None else (exposed.sequence - last) % _SEQUENCE_WRAP
        backwards = not 0 < step < _SEQUENCE_WRAP // 2
        came_back, self._reconnected_description = self._reconnected_description, None
        other = came_back is not None and self.clock.reconfigure(*_clock(came_back), arrival_ns)
        if backwards and not other:
            self.clock.restart(arrival_ns)
        stamp = self.clock.stamp(exposed.ticks, arrival_ns)
        anew = backwards or other or stamp.restarted
        if anew:  # the number lost is unknown
            step = 1
        self._last_number = exposed.sequence
        self._sequence += step
        self.lost += step - 1
        flags = FrameFlag.OVERFLOW if step > 1 or anew else FrameFlag.NONE
        if exposed.flags & LinesFlag.SATURATED:
            flags |= FrameFlag.SATURATED
        self.built += 1
        return LineFrame(
            self._device,
            self._sequence,
            stamp.device_ns,
            host_time_ns(stamp.host_ns),
            marker,
            exposed.lines,
            flags,
        )
