"""Replay of a recording as a driver; frames are bit-identical."""

import math
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from threading import Event, Lock

from compute.parameter_checks import require
from hardware.clock_sync import HostClock, wait_until
from hardware.driver import DeviceDescription, SessionDriver
from hardware.line_frame import LineFrame
from hardware.recording.reader import RecordingReader


class ReplayDriver(SessionDriver["_Playback"]):
    """Replays a recording: scans, sequence numbers, device times, markers and flags as recorded.

    Paced, a frame is delivered when it is due, at ``speed`` times the rate of the device's
    clock, and ``exposure_host_ns`` is replaced by that time: latencies and the alignment with
    other devices of this host refer to now, not to the recording. A slow host loses nothing:
    late frames follow at once, stamped with the time when they were due. Without pacing
    ``exposure_host_ns`` is the recorded one. The recorded host times remain in the file:
    ``RecordingReader(path).column("exposure_host_ns")``.

    Args:
        name: the device's name here; it may differ from the recorded one.
        path: the recording.
        speed: 1.0 as recorded, 2.0 twice as fast; None: as fast as frames are consumed.

    Raises:
        InvalidParameter: the speed is not positive.
    """

    def __init__(self, name: str, path: Path, speed: float | None = 1.0) -> None:
        super().__init__()
        valid = speed is None or 0.0 < speed < math.inf
        require(valid, "be positive, or None for as fast as taken", speed=speed)
        self._name = name
        self._path = path
        self._speed = speed

    @property
    def lossless(self) -> bool:
        """Whether it waits for its consumer: only where it is not paced."""
        return self._speed is None

    @property
    def description(self) -> DeviceDescription:
        """The recorded device's properties, under the name given here; valid after ``open``.

        Raises:
            RuntimeError: the driver was never opened.
        """
        return replace(self._opened().recording.info.description, name=self._name)

    def open(self) -> None:
        """Open and check the file; ``frames`` begins at its first frame.

        Raises:
            InvalidRecording: see ``RecordingReader``.
        """
        self.close()
        self._session = _Playback(RecordingReader(self._path))

    def frames(self) -> Iterator[LineFrame]:
        """Yield the frames until the file ends or ``close`` is called.

        Raises:
            InvalidRecording: the stored data are damaged.
            RuntimeError: the driver was never opened.
        """
        return self._play(self._opened())

    def _play(self, run: "_Playback") -> Iterator[LineFrame]:
        start_ns = 0
        first_device_ns: int | None = None
        host_clock = HostClock()
        for recorded in run.frames():
            frame = replace(recorded, device=self._name)
            if self._speed is not None:
                if first_device_ns is None:
                    first_device_ns, start_ns = frame.exposure_device_ns, time.monotonic_ns()
                passed_ns = frame.exposure_device_ns - first_device_ns
                due_ns = start_ns + round(passed_ns / self._speed)
                wait_until(due_ns, run.closed)
                frame = replace(frame, exposure_host_ns=host_clock.convert(due_ns)[1])
            if run.closed.is_set():
                return
            yield frame


class _Playback:
    """An open recording; a lock keeps reading and closing apart."""

    def __init__(self, recording: RecordingReader) -> None:
        self.recording = recording
        self.closed = Event()
        self._lock = Lock()

    def frames(self) -> Iterator[LineFrame]:
        """Yield the recorded frames until closed."""
        for first in self.recording.chunk_starts():
            with self._lock:
                if self.closed.is_set():
                    return
                frames = self.recording.chunk(first)
            yield from frames

    def close(self) -> None:
        """Close the file, between two reads."""
        self.closed.set()
        with self._lock:
            self.recording.close()
