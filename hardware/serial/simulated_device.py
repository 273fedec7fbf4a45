"""Simulated firmware of a serial device; ``emulator`` connects it to a port.

The frames are the simulator's. It supports all commands; exposures that are not fetched in time
are lost and counted.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np

from compute.errors import InvalidParameter
from hardware.serial.codec import encode, split_lines
from hardware.serial.decoder import Decoder
from hardware.serial.messages import (
    NO_MARKER,
    Ability,
    Answer,
    Describe,
    Description,
    DeviceStatus,
    Exposure,
    Lines,
    LinesFlag,
    Message,
    MessageType,
    Result,
    Start,
    Stop,
    Strobe,
)
from hardware.simulated.driver import FrameRenderer
from hardware.simulated.frame_batch import BATCH, Batch
from hardware.simulated.settings import SimulationSettings
from hardware.simulated.simulated_rig import PIXELS, simulated_rig
from hardware.strobe_schedule import StrobeSchedule

CLOCK_HZ: Final = 1_000_000
STATUS_NS: Final = 1_000_000_000
FIFO_S: Final = 0.25
"""Length of its buffer of exposures."""

_COMMANDS: Final = {
    Start: MessageType.START,
    Stop: MessageType.STOP,
    Exposure: MessageType.EXPOSURE,
    Strobe: MessageType.STROBE,
}


class SimulatedSerialDevice:
    """A simulated serial device, from power-on.

    Args:
        settings: the simulation; its duration and pace play no part.
        now_ns: the moment when it is switched on, of the clock that all calls go by [ns].
        name: what it calls itself.
        rendered: number of exposures rendered once and repeated; None: each is rendered.
        part_counts: counts of a message, for a device that cannot hold an exposure; None: all.
    """

    def __init__(
        self,
        settings: SimulationSettings,
        now_ns: int,
        name: str = "simulated-bar",
        rendered: int | None = None,
        part_counts: int | None = None,
    ) -> None:
        self.name = name
        self._settings = replace(settings, duration_s=None)
        self._rendered = rendered
        self._part_counts = part_counts
        self._decoder = Decoder()
        self._lost = 0
        self._begin_ns = now_ns
        self._status_ns = now_ns
        self._exposing = False
        self._sequence = 0
        self._first = 0
        self._start_ns = now_ns
        self._batches: dict[int, Batch] = {}
        self._renderer = FrameRenderer(self._settings)

    def description(self) -> Description:
        """Return its description."""
        settings = self._settings
        sensors = simulated_rig()
        return Description(
            name=self.name,
            sensors=tuple(sensor.model.name for sensor in sensors),
            pixels=PIXELS,
            pitch_um=sensors[0].pitch_um,
            clock_hz=CLOCK_HZ,
            clock_bits=32,
            bits=settings.bits,
            electrons_per_count=settings.electrons_per_count,
            read_noise_electrons=settings.read_noise_electrons,
            offset_counts=settings.offset_counts,
            frame_rate_hz=settings.frame_rate_hz,
            line_sigma_px=settings.spot_sigma_px,
            markers=settings.strobed_markers,
            abilities=Ability.START_STOP | Ability.EXPOSURE | Ability.STROBE,
        )

    def boot(self) -> bytes:
        """Return the bytes sent at power-on."""
        return b"\0" + encode(self.description())

    def receive(self, data: bytes, now_ns: int) -> bytes:
        """Process bytes of the host; return the answers."""
        return b"".join(self._execute(message, now_ns) for message in self._decoder.feed(data))

    def due_ns(self) -> int:
        """Return the time of the next exposure's centre or the next status [ns]."""
        if not self._exposing:
            return self._status_ns
        return min(self._status_ns, self._time_ns(self._sequence))

    def send(self, now_ns: int) -> Iterator[bytes]:
        """Yield the messages of the exposures until now, and the periodic status."""
        if now_ns >= self._status_ns:
            self._status_ns = now_ns + STATUS_NS
            counters = self._decoder.counters
            yield encode(DeviceStatus(self._ticks(now_ns), 25.0, self._lost, counters.discarded))
        if not self._exposing:
            return
        rate = self._settings.frame_rate_hz
        passed = int((now_ns - self._start_ns) * 1e-9 * rate - 0.5) + self._first
        oldest = passed - max(2, int(FIFO_S * rate))
        if oldest > self._sequence:
            self._lost += oldest - self._sequence
            self._sequence = oldest
        while self._exposing and self._time_ns(self._sequence) <= now_ns:
            yield from self._lines(self._sequence)
            self._sequence += 1

    def _lines(self, sequence: int) -> Iterator[bytes]:
        index = sequence if self._rendered is None else sequence % self._repeated(self._rendered)
        number, offset = divmod(index, BATCH)
        batch = self._batches.get(number)
        if batch is None:
            if self._rendered is None:
                self._batches.clear()
            batch = self._batches[number] = self._renderer.batch(number)
        marker = self._settings.timing.marker(index)
        scan_message = Lines(
            sequence % 2**32,
            self._ticks(self._time_ns(sequence)),
            NO_MARKER if marker is None else marker,
            LinesFlag.SATURATED if batch.saturated[offset] else LinesFlag.NONE,
            self._lost % 2**32,
            0,
            np.ravel(batch.lines[offset]),
        )
        parts = (
            [scan_message]
            if self._part_counts is None
            else split_lines(scan_message, self._part_counts)
        )
        for part in parts:
            yield encode(part)

    def _repeated(self, minimum: int) -> int:
        """Return the period of repetition: a whole number of strobe cycles."""
        timing = self._settings.timing
        cycle = len(timing.schedule) or timing.strobed_markers or 1
        return -(-minimum // cycle) * cycle

    def _time_ns(self, sequence: int) -> int:
        """Return the centre of an exposure [ns]."""
        since = sequence - self._first + 0.5
        return self._start_ns + round(since * 1e9 / self._settings.frame_rate_hz)

    def _ticks(self, now_ns: int) -> int:
        return (now_ns - self._begin_ns) * CLOCK_HZ // 1_000_000_000 % 2**32

    def _execute(self, message: Message, now_ns: int) -> bytes:
        if isinstance(message, Describe):
            return encode(self.description())
        if not isinstance(message, Start | Stop | Exposure | Strobe):
            return b""
        result = self._result_of(message, now_ns)
        return encode(Answer(_COMMANDS[type(message)], message.number, result))

    def _result_of(self, command: Start | Stop | Exposure | Strobe, now_ns: int) -> Result:
        if isinstance(command, Start):
            if not self._exposing:
                self._exposing = True
                self._restart(now_ns)
            return Result.DONE
        if isinstance(command, Stop):
            self._exposing = False
            return Result.DONE
        try:
            if isinstance(command, Exposure):
                rate = command.frame_rate_hz or self._settings.frame_rate_hz
                settings = replace(self._settings, frame_rate_hz=rate)
            else:
                settings = self._strobed(command)
        except InvalidParameter:
            return Result.OUT_OF_RANGE
        self._settings = settings
        self._renderer = FrameRenderer(settings)
        self._batches.clear()
        self._restart(now_ns)
        return Result.DONE

    def _strobed(self, command: Strobe) -> SimulationSettings:
        """Return the settings with a schedule; raises InvalidParameter."""
        if not command.slots or set(command.slots) == {NO_MARKER}:
            return replace(self._settings, illumination="simultaneous", strobe=None)
        slots = tuple(None if slot == NO_MARKER else slot for slot in command.slots)
        return replace(self._settings, illumination="strobed", strobe=StrobeSchedule(slots))

    def _restart(self, now_ns: int) -> None:
        """Restart the timing of exposures from now, at the current rate."""
        self._first, self._start_ns = self._sequence, now_ns
