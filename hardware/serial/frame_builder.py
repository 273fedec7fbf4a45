"""Builds line frames from messages: reassembly, continuous numbers, times on both clocks."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from hardware.clock_sync import DeviceClock, HostClock
from hardware.line_frame import FrameFlag, LineFrame
from hardware.serial.messages import NO_MARKER, Description, Lines, LinesFlag

_SEQUENCE_WRAP: Final = 2**32
_MAX_RATE_HZ: Final = 100_000
"""No sensor is read more often: numbers that rise faster are no count of exposures."""
_LATE_NS: Final = 1_000_000_000
"""How much later than the next an exposure may arrive."""


class ExposureAssembler:
    """Reassembles exposures of (sensors, pixels) from parts in order.

    Attributes:
        incomplete: exposures with a missing part.
        orphaned: parts without an exposure: its beginning was lost, or they do not fit.
    """

    def __init__(self, sensors: int, pixels: int) -> None:
        self.incomplete = 0
        self.orphaned = 0
        self._shape = (sensors, pixels)
        self._size = sensors * pixels
        self._begun: Lines | None = None
        self._filled = 0
        self._flags = LinesFlag.NONE
        self._counts = np.empty(0, dtype=np.uint16)

    def reset(self) -> None:
        """Discard an unfinished exposure without counting it."""
        self._begun = None

    def add(self, part: Lines) -> Lines | None:
        """Add a part; return the exposure it completes, counts (sensors, pixels), read-only."""
        if part.first == 0 and len(part.counts) == self._size:
            self._drop()
            return self._assemble(part, part.counts, part.flags)
        begun = self._begun
        end = part.first + len(part.counts)
        if part.first == 0 and end < self._size:
            self._drop()
            self._begun, self._filled, self._flags = part, end, part.flags
            self._counts = np.empty(self._size, dtype=np.uint16)
            self._counts[:end] = part.counts
            return None
        if (
            begun is None
            or (part.sequence, part.ticks) != (begun.sequence, begun.ticks)
            or part.first != self._filled
            or end > self._size
        ):
            self._drop()
            self.orphaned += 1
            return None
        self._counts[part.first : end] = part.counts
        self._filled = end
        self._flags |= part.flags
        if end < self._size:
            return None
        self._begun = None
        self._counts.setflags(write=False)
        return self._assemble(part, self._counts, self._flags)

    def _drop(self) -> None:
        if self._begun is not None:
            self._begun = None
            self.incomplete += 1

    def _assemble(self, part: Lines, counts: NDArray[np.uint16], flags: LinesFlag) -> Lines:
        shaped = counts.reshape(self._shape)
        return Lines(part.sequence, part.ticks, part.marker, flags, part.lost, 0, shaped)


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
        refused: exposures with an invalid marker, and those that were sent before.
        irregular: exposures before which the device's numbers or its clock began anew, stood
            still, or jumped by more than any sensor is read, while the device stayed connected.
    """

    def __init__(self, device: str, description: Description, markers: int) -> None:
        self.clock = DeviceClock(*_clock(description))
        self.built = 0
        self.lost = 0
        self.refused = 0
        self.irregular = 0
        self._device = device
        self._markers = markers
        self._last: tuple[int, int] | None = None
        self._arrival_ns = 0
        self._host_clock = HostClock()
        self._device_ns = -1
        self._sequence = -1
        self._reconnected_description: Description | None = None

    def reconnect(self, description: Description) -> None:
        """Use the clock and delay of a new description from the next exposure on."""
        self._reconnected_description = description

    def build(self, exposed: Lines, arrival_ns: int) -> LineFrame | None:
        """Return the frame of an exposure that arrived at a monotonic time [ns].

        None: its marker is invalid, or it came before.

        Raises:
            InvalidParameter: the clock of the reconnected device wraps too often.
        """
        marker = None if exposed.marker == NO_MARKER else exposed.marker
        if marker is not None and marker >= self._markers:
            self.refused += 1
            return None
        last, since_ns = self._last, arrival_ns - self._arrival_ns
        step = 1 if last is None else (exposed.sequence - last[0]) % _SEQUENCE_WRAP
        came_back, self._reconnected_description = self._reconnected_description, None
        if (exposed.sequence, exposed.ticks) == last and came_back is None:
            self.refused += 1
            return None
        max_step = 1 + (since_ns + _LATE_NS) * _MAX_RATE_HZ // 1_000_000_000
        stands = last is not None and exposed.ticks == last[1]
        jumps = stands or not 0 < step <= min(max_step, _SEQUENCE_WRAP // 2 - 1)
        other = came_back is not None and self.clock.reconfigure(*_clock(came_back), arrival_ns)
        if jumps and not other:
            self.clock.restart(arrival_ns)
        stamp = self.clock.stamp(exposed.ticks, arrival_ns)
        restarted = jumps or other or stamp.restarted
        if restarted:  # the number lost is unknown
            step = 1
            self.irregular += came_back is None
        self._last = (exposed.sequence, exposed.ticks)
        self._arrival_ns = arrival_ns
        self._sequence += step
        self.lost += step - 1
        self._device_ns = max(stamp.device_ns, self._device_ns + 1)
        _, host_ns = self._host_clock.convert(stamp.host_ns)
        flags = FrameFlag.OVERFLOW if step > 1 or restarted else FrameFlag.NONE
        if exposed.flags & LinesFlag.SATURATED:
            flags |= FrameFlag.SATURATED
        self.built += 1
        return LineFrame(
            self._device,
            self._sequence,
            self._device_ns,
            host_ns,
            marker,
            exposed.counts,
            flags,
            self.clock.uncertainty_ns,
        )
