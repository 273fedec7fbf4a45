"""Driver for GenICam line-scan cameras: a frame is one scan of each camera."""

import time
from collections.abc import Iterator
from threading import Event, Lock
from typing import Final

import numpy as np

from compute.errors import InvalidParameter
from hardware.clock_sync import HostClock
from hardware.driver import DeviceDescription, SensorDescription
from hardware.errors import DeviceNotConnected
from hardware.genicam.camera_stream import CameraStream
from hardware.genicam.frame_sync import CameraScan, FrameSynchroniser
from hardware.genicam.pixel_formats import bits_per_pixel
from hardware.genicam.settings import GenicamSettings
from hardware.line_frame import FrameFlag, LineFrame
from hardware.link import LinkPhase, LinkReport, ReportingDriver, most_severe

SILENCE_S: Final = 1.0
"""Silence after which a camera's presence is checked."""

_WAIT_US: Final = 20_000
_CLOSE_S: Final = 0.5


class GenicamDriver(ReportingDriver["_Run"]):
    """Driver that combines simultaneous scans of several cameras to frames.

    Frames carry the first camera's numbers and its clock. A camera that is lost is opened again
    until it is back; meanwhile there are no frames.

    Args:
        name: the device's name.
        settings: the cameras; see ``GenicamSettings``.
    """

    lossless = False

    def __init__(self, name: str, settings: GenicamSettings) -> None:
        super().__init__()
        self._name = name
        self._settings = settings

    @property
    def description(self) -> DeviceDescription:
        """The device's properties; valid after ``open``.

        Raises:
            RuntimeError: the driver was never opened.
        """
        settings, run = self._settings, self._opened()
        return DeviceDescription(
            name=self._name,
            sensors=tuple(
                SensorDescription(camera.name, stream.width, settings.pitch_um)
                for camera, stream in zip(settings.cameras, run.streams, strict=True)
            ),
            frame_rate_hz=run.line_rate_hz,
            bits=bits_per_pixel(settings.pixel_format),
            electrons_per_count=settings.electrons_per_count,
            read_noise_electrons=settings.read_noise_electrons,
            offset_counts=settings.offset_counts,
            markers=0,
            peaks=settings.peaks,
        )

    def open(self) -> None:
        """Open and configure all cameras.

        Raises:
            DeviceNotConnected: one is not there, or another program controls it.
            InvalidParameter: one cannot be set so, or their lines differ in length.
            MissingLibrary: Aravis is not installed.
        """
        self.close()
        self._report.reset()
        run = self._session = _Run(self._name, self._settings, self._report)
        run.open()

    def frames(self) -> Iterator[LineFrame]:
        """Yield frames until ``close`` is called.

        Raises:
            DeviceChanged: a camera came back with another width.
            InvalidParameter: one that came back refuses its settings.
            RuntimeError: the driver was never opened.
        """
        run = self._opened()
        while (frames := run.step()) is not None:
            for frame in frames:
                if run.closed.is_set():
                    return
                yield frame


class _Run:
    """The opened cameras, from ``open`` to ``close``; a lock guards them."""

    def __init__(self, name: str, settings: GenicamSettings, report: LinkReport) -> None:
        self.closed = Event()
        self.streams = [CameraStream(camera, settings) for camera in settings.cameras]
        self.line_rate_hz = 0.0
        self._name = name
        self._report = report
        self._bits = bits_per_pixel(settings.pixel_format)
        self._matcher = FrameSynchroniser(len(self.streams), round(settings.match_us * 1e3))
        self._lock = Lock()
        self._started = False
        self._last_contact_s = [0.0] * len(self.streams)
        self._garbled = [False] * len(self.streams)
        self._sequence = -1
        self._host_clock = HostClock()
        self._restarts: int | None = None
        self._faults: dict[int, tuple[LinkPhase, str]] = {}

    def open(self) -> None:
        """Open all cameras; close them again on an error."""
        with self._lock:
            try:
                for stream in self.streams:
                    if self.closed.is_set():
                        raise DeviceNotConnected("the driver was closed while it was opened")
                    stream.open()
                self._check_widths()
            except BaseException:
                self._release()
                raise
            self.line_rate_hz = self.streams[0].line_rate_hz

    def close(self) -> None:
        """Stop; a step that is under way releases the cameras at its end."""
        self.closed.set()
        if self._lock.acquire(timeout=_CLOSE_S):
            try:
                self._release()
            finally:
                self._lock.release()
        # A camera that is there is let go in milliseconds; who opens it next finds it free.
        for stream in self.streams:
            stream.wait_closed(_CLOSE_S)

    def step(self) -> list[LineFrame] | None:
        """Return the frames that arrived within some milliseconds; None: closed."""
        with self._lock:
            try:
                if self.closed.is_set():
                    return None
                if not self._started:
                    self._start()
                self._listen()
                frames = []
                while (matched := self._matcher.take()) is not None:
                    frames.append(self._frame(matched))
            except BaseException:
                self._release()
                raise
            finally:
                if self.closed.is_set():
                    self._release()
            return frames

    def _start(self) -> None:
        self._started = True
        for index, stream in enumerate(self.streams):
            self._last_contact_s[index] = time.monotonic()
            try:
                stream.start()
            except DeviceNotConnected as error:
                stream.mark_lost(error.detail)
                self._record_fault(index, "disconnected", _waiting(stream))

    def _listen(self) -> None:
        """Receive the buffers of every camera; check those that are silent."""
        waiting_us = _WAIT_US // len(self.streams)
        for index, stream in enumerate(self.streams):
            if not stream.connected:
                self._reconnect(index, stream)
                continue
            wait_us = waiting_us
            while (buffer := stream.take(wait_us)) is not None:
                wait_us = 0
                self._report.count(received_bytes=buffer.bytes)
                if buffer.lines is None:
                    self._garbled[index] = True
                    self._report.count(frames_garbled=1)
                    continue
                self._last_contact_s[index], self._garbled[index] = time.monotonic(), False
                lost, restarts = stream.frame_counter.lost, stream.timestamps.restarts
                for line in stream.lines(buffer):
                    self._matcher.add(index, line)
                self._report.count(
                    frames_lost=(stream.frame_counter.lost - lost) * len(buffer.lines),
                    clock_restarts=stream.timestamps.restarts - restarts,
                )
                if self.closed.is_set():
                    return
            if time.monotonic() - self._last_contact_s[index] > SILENCE_S:
                self._service_camera(index, stream)

    def _service_camera(self, index: int, stream: CameraStream) -> None:
        """Diagnose a silent camera: disconnected, garbled or waiting for a trigger."""
        if not stream.is_present():
            stream.mark_lost(f"{stream.name} does not answer any more")
            self._matcher.forget()
            self._record_fault(index, "disconnected", _waiting(stream))
        elif self._garbled[index]:
            self._record_fault(
                index, "garbled", f"{stream.name} sends, but parts of all buffers are lost"
            )
        else:
            self._record_fault(
                index,
                "silent",
                f"{stream.name} answers, but no lines came for {SILENCE_S:g} s: it may wait for a "
                "trigger",
            )
        self._last_contact_s[index] = time.monotonic()

    def _reconnect(self, index: int, stream: CameraStream) -> None:
        if stream.reconnect():
            self._report.count(reconnects=1)
            self._last_contact_s[index] = time.monotonic()
            self._garbled[index] = False
            del self._faults[index]  # reported when there is a frame
        else:
            self._record_fault(index, "disconnected", _waiting(stream))
            self.closed.wait(_WAIT_US * 1e-6)

    def _record_fault(self, index: int, phase: LinkPhase, reason: str) -> None:
        """Record a camera's fault and report the most severe of all."""
        self._faults[index] = phase, reason
        self._report.set_state(*most_severe(self._faults.values()))

    def _frame(self, matched: tuple[CameraScan, ...]) -> LineFrame:
        first = matched[0]
        unmatched, self._matcher.unmatched = self._matcher.unmatched, 0
        self._report.count(frames_received=1, frames_incomplete=unmatched)
        self._faults.clear()
        self._report.set_state("connected")
        lines = np.stack([line.counts for line in matched])
        flags = FrameFlag.NONE
        restarts = sum(line.restarts for line in matched)
        restarted = self._restarts is not None and restarts != self._restarts
        if restarted or (self._sequence >= 0 and first.number != self._sequence + 1):
            flags |= FrameFlag.OVERFLOW
        if bool((lines >= 2**self._bits - 1).any()):
            flags |= FrameFlag.SATURATED
        self._sequence, self._restarts = first.number, restarts
        _, host_ns = self._host_clock.convert(
            sum(line.monotonic_ns for line in matched) // len(matched)
        )
        return LineFrame(
            device=self._name,
            sequence=first.number,
            exposure_device_ns=first.device_ns,
            exposure_host_ns=host_ns,
            marker=None,
            lines=lines,
            flags=flags,
            # Their shortest delays are not known either: the worst camera's.
            host_sigma_ns=max(stream.timestamps.uncertainty_ns for stream in self.streams),
        )

    def _check_widths(self) -> None:
        widths = {stream.width for stream in self.streams}
        if len(widths) > 1:
            listed = ", ".join(f"{stream.name}: {stream.width}" for stream in self.streams)
            raise InvalidParameter(
                f"the cameras' lines differ in length ({listed}); set one width for all"
            )

    def _release(self) -> None:
        for stream in self.streams:
            stream.close()


def _waiting(stream: CameraStream) -> str:
    return f"{stream.reason}; it is opened again when it is back"
