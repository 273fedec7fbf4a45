"""SerialDriver: driver of a device on a serial port that reconnects after a loss."""

import math
import time
from collections.abc import Callable, Iterator
from threading import Lock
from typing import Final

from hardware.driver import DeviceDescription, SensorDescription, SessionDriver
from hardware.errors import DeviceChanged, DeviceNotConnected
from hardware.line_frame import LineFrame
from hardware.link import LinkCounters, LinkPhase, LinkState
from hardware.serial.connection import Connection
from hardware.serial.decoder import Decoder
from hardware.serial.frame_builder import FrameBuilder
from hardware.serial.link_watchdog import DescribePolicy, LinkWatchdog, RegularityWatch
from hardware.serial.messages import Answer, Description, DeviceStatus, Lines, Message
from hardware.serial.port import CloseSignal, PortDisconnected
from hardware.serial.settings import SerialSettings

RETRY_S: Final = (0.05, 0.1, 0.2, 0.5, 1.0)
"""Delays before the attempts to connect; the last one repeats."""
_EXPOSURES: Final = 3.0
_NOT_OPENED: Final[tuple[LinkPhase, str]] = ("disconnected", "it was not opened yet")


class SerialDriver(SessionDriver["SerialSession"]):
    """A device that speaks the line-scan protocol on a serial port; a ``LinkedDriver``.

    Args:
        name: the device's name.
        settings: port, and settings sent to the device.
    """

    lossless = False

    def __init__(self, name: str, settings: SerialSettings) -> None:
        super().__init__()
        self._name = name
        self._settings = settings
        self._changed: Callable[[LinkState], None] = lambda _: None

    @property
    def description(self) -> DeviceDescription:
        """The device's properties, from its description; valid after ``open``.

        Raises:
            RuntimeError: the driver is not open.
        """
        return self._opened().description

    def open(self) -> None:
        """Connect and read the description; takes at most 5 s, 3 s more if it is busy.

        Raises:
            DeviceNotConnected: it is not there, does not answer, or stays busy.
            InvalidParameter: it does not support its settings.
        """
        self.close()
        session = self._session = SerialSession(self._name, self._settings)
        session.open()

    def listen(self, changed: Callable[[LinkState], None]) -> None:
        """Register the listener of link changes; called from the thread of ``frames``."""
        self._changed = changed

    def link(self) -> LinkState:
        """Return the state of the link; "disconnected" before ``open``."""
        session = self._session
        return LinkState(*_NOT_OPENED) if session is None else session.link()

    def frames(self) -> Iterator[LineFrame]:
        """Yield frames until ``close`` is called; reconnect after each loss.

        Raises:
            DeviceChanged: another device came back, or one with other values of its sensors.
            InvalidParameter: the device refuses its settings, or its clock cannot be counted on.
            RuntimeError: the driver is not open.
        """
        return self._opened().frames(self._changed)


class SerialSession:
    """A serial device between ``open`` and ``close``; see SerialDriver."""

    def __init__(self, name: str, settings: SerialSettings) -> None:
        self._settings = settings
        self._closing = CloseSignal()
        self._decoder = Decoder()
        self._owned = Lock()
        self._state: tuple[LinkPhase, str | None] = _NOT_OPENED
        self._reconnects = 0
        self._incomplete = 0
        self._describe_policy = DescribePolicy()
        self._regularity = RegularityWatch()
        self._temperature_c: float | None = None
        self._connection: Connection | None = None
        self._name = name
        self._builder: FrameBuilder | None = None
        self._changed: Callable[[LinkState], None] = lambda _: None

    def open(self) -> None:
        """Connect for the first time; raises as ``SerialDriver.open``."""
        with self._owned:
            try:
                self._connect()
            except PortDisconnected as error:
                self._release()
                raise DeviceNotConnected(f"{self._settings.url}: {error}") from error
            except BaseException:
                self._release()
                raise
        if self._closing.is_set():  # closed when it was open already
            self.close()

    def close(self) -> None:
        """End the frames and release the port, here or in the thread of ``frames``."""
        self._closing.set()
        if self._owned.acquire(blocking=False):
            try:
                self._release()
            finally:
                self._owned.release()

    def link(self) -> LinkState:
        """Return the state of the link."""
        state, reason = self._state
        builder, connection, decoder = self._builder, self._connection, self._decoder.counters
        if builder is None:
            return LinkState(state, reason)
        open_ones = connection.assembler.incomplete if connection else 0
        uncertainty = builder.clock.uncertainty_ns
        known = math.isfinite(uncertainty)
        return LinkState(
            state,
            reason,
            LinkCounters(
                received_bytes=decoder.bytes_received,
                frames_received=builder.built,
                frames_garbled=decoder.discarded + builder.refused,
                frames_incomplete=self._incomplete + open_ones,
                frames_lost=builder.lost,
                reconnects=self._reconnects,
                clock_restarts=builder.clock.restarts,
            ),
            uncertainty * 1e-3 if known else None,
            builder.clock.rate * 1e6 if known else None,
            self._temperature_c,
        )

    def frames(self, changed: Callable[[LinkState], None]) -> Iterator[LineFrame]:
        """Yield frames until closed; call ``changed`` with each change of the link."""
        with self._owned:
            self._changed = changed
            try:
                while not self._closing.is_set():
                    try:
                        connection = self._connection or self._reconnected()
                        if connection is not None:
                            yield from self._stream(connection)
                    except PortDisconnected as error:
                        self._release_connection()
                        if not self._closing.is_set():
                            reason = f"{self._settings.url} was lost: {error}; trying again"
                            self._set_state("disconnected", reason)
            finally:
                self._closing.set()
                self._release()

    def _stream(self, connection: Connection) -> Iterator[LineFrame]:
        """Yield the frames of one connection; raises PortDisconnected."""
        builder, watch = self._builder, self._watch
        assert builder is not None
        while not self._closing.is_set():
            messages, now_ns, received = connection.read(watch.limit_s / 2.0)
            built, others = builder.built, False
            for message in messages:
                if isinstance(message, Lines):
                    exposed = connection.assembler.add(message)
                    frame = None if exposed is None else builder.build(exposed, now_ns)
                    if frame is not None:
                        yield frame
                        if self._closing.is_set():
                            return
                else:
                    others = True
                    self._other(connection, message, now_ns)
            frames = builder.built > built
            if received:
                watch.received(
                    now_ns, frames=frames, messages=others, rejected=self._bad(connection)
                )
            if frames:
                self._decoder.complaint = None
                self._describe_policy.record_frames()
            state, reason = watch.check(now_ns)
            stopped = state != "connected"
            irregular = self._regularity.check(builder.irregular, now_ns)
            if irregular is not None and not stopped:
                state, reason = "garbled", irregular
            elif state == "garbled" and self._decoder.complaint is not None:
                reason = f"{self._decoder.complaint}; check the device's firmware"
            self._set_state(state, reason)
            if stopped and self._describe_policy.should_describe(now_ns):
                connection.request_description()

    def _bad(self, connection: Connection) -> int:
        """Return the number of unusable messages and exposures."""
        parts, builder = connection.assembler, self._builder
        assert builder is not None
        discarded = self._decoder.counters.discarded
        return discarded + parts.incomplete + parts.orphaned + builder.refused

    def _other(self, connection: Connection, message: Message, now_ns: int) -> None:
        """Handle a message without counts; reconfigure a device that was reset."""
        if isinstance(message, Description):
            self._accept_description(message)
            connection.description = message
            if self._describe_policy.should_configure(now_ns):
                connection.send_settings()
        elif isinstance(message, Answer):
            connection.handle_answer(message, now_ns)
        elif isinstance(message, DeviceStatus) and math.isfinite(message.temperature_c):
            self._temperature_c = message.temperature_c

    def _connect(self) -> Connection:
        """Connect and start the device; raises DeviceNotConnected, PortDisconnected, ..."""
        connection = Connection(self._settings, self._decoder, self._closing)
        try:
            if self._builder is None:
                self._begin(connection.description)
            else:
                self._accept_description(connection.description)
            connection.start()
        except BaseException:
            connection.close()
            raise
        self._connection = connection
        now_ns = time.monotonic_ns()
        self._describe_policy.begin(now_ns)
        self._watch.begin(now_ns, self._bad(connection))
        self._set_state("connected", None)
        return connection

    def _begin(self, described: Description) -> None:
        """Create what depends on the device's description."""
        settings = self._settings
        markers = settings.strobe.markers if settings.strobe else described.markers
        self._described = described
        self._builder = FrameBuilder(self._name, described, markers)
        self._watch = LinkWatchdog(self._limit_s(described))
        self.description = DeviceDescription(
            name=self._name,
            sensors=tuple(
                SensorDescription(name, described.pixels, described.pitch_um)
                for name in described.sensors
            ),
            frame_rate_hz=settings.frame_rate_hz or described.frame_rate_hz,
            bits=described.bits,
            electrons_per_count=described.electrons_per_count,
            read_noise_electrons=described.read_noise_electrons,
            offset_counts=described.offset_counts,
            markers=markers,
            peaks=settings.peaks,
            line_sigma_px=described.line_sigma_px or None,
        )

    def _limit_s(self, described: Description) -> float:
        """Return the longest tolerated time without frames [s]."""
        rate = self._settings.frame_rate_hz or described.frame_rate_hz
        return max(self._settings.silent_after_s, _EXPOSURES / rate if rate else 0.0)

    def _accept_description(self, described: Description) -> None:
        """Accept the description of a reconnected device.

        Raises:
            DeviceChanged: it is another device.
        """
        check_identity(self._described, described)
        assert self._builder is not None
        self._builder.reconnect(described)
        self._watch.limit_s = self._limit_s(described)

    def _reconnected(self) -> Connection | None:
        """Retry the connection until it succeeds; None: closed meanwhile."""
        attempts = 0
        while not self._closing.wait(RETRY_S[min(attempts, len(RETRY_S) - 1)]):
            attempts += 1
            try:
                connection = self._connect()
            except DeviceNotConnected as error:
                self._set_state("disconnected", f"{error.detail}; trying again")
            except PortDisconnected as error:
                self._set_state("disconnected", f"{self._settings.url}: {error}; trying again")
            else:
                self._reconnects += 1
                return connection
        return None

    def _set_state(self, state: LinkPhase, reason: str | None) -> None:
        if (state, reason) != self._state:
            self._state = (state, reason)
            self._changed(self.link())

    def _release_connection(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            self._incomplete += connection.assembler.incomplete
            connection.close()

    def _release(self) -> None:
        if self._connection is not None:
            self._connection.stop()
        self._release_connection()
        self._closing.close()


_IDENTITY_VALUES: Final = (
    ("pitch_um", "pixel pitch", "um"),
    ("bits", "conversion", "bits"),
    ("electrons_per_count", "gain", "electrons per count"),
    ("read_noise_electrons", "read noise", "electrons"),
    ("offset_counts", "offset", "counts"),
    ("line_sigma_px", "line width", "px"),
)
"""Values used by peaks and calibrations; clock, delay and rate may differ."""


def check_identity(before: Description, now: Description) -> None:
    """Raise DeviceChanged where sensors or values used in computations differ."""
    if (now.sensors, now.pixels) != (before.sensors, before.pixels):
        raise DeviceChanged(
            f"{now.name} came back with the sensors {', '.join(now.sensors)} of {now.pixels} px; "
            f"before there were {', '.join(before.sensors)} of {before.pixels} px; start the "
            "device anew",
        )
    for name, noun, unit in _IDENTITY_VALUES:
        old, new = getattr(before, name), getattr(now, name)
        if old != new:
            raise DeviceChanged(
                f"{now.name} came back with the {noun} {new:g} {unit}; before it was {old:g} "
                f"{unit}; start the device anew, and see whether its calibration still holds",
            )
