"""Replay: a recorded file as a driver, frame by frame the same bits."""

import math
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from threading import Event, Lock

from compute.errors import InvalidParameter
from hardware.driver import DeviceDescription
from hardware.line_frame import LineFrame
from hardware.recording.reader import RecordingReader
from hardware.timing import host_time_ns, wait_until


class ReplayDriver:
    """Plays a recording; lines, sequence numbers, device times, markers and flags as recorded.

    Paced, a frame is handed out when its exposure comes round again, at ``speed`` times the
    pace of the device's clock, and ``exposure_host_ns`` is stamped anew with that moment: the
    recorded one is long past, and whoever measures a latency or aligns the frame with another
    device of this host means now. A host that is slow loses nothing: late frames follow at
    once, stamped with the time when they were due. As fast as taken, nothing is stamped:
    ``exposure_host_ns`` is the recorded one. With pacing too the recorded host times remain in
    the file: ``RecordingReader(path).column("exposure_host_ns")``.

    Args:
        name: the device's name here; it may differ from the recorded one.
        path: the recording.
        speed: 1.0 as recorded, 2.0 twice as fast; None: as fast as taken.

    Raises:
        InvalidParameter: the speed is not positive.
    """

    def __init__(self, name: str, path: Path, speed: float | None = 1.0) -> None:
        if speed is not None and not 0.0 < speed < math.inf:
            raise InvalidParameter(
                f"speed is {speed}; it must be positive, or None for as fast as taken",
                speed=speed,
            )
        self._name = name
        self._path = path
        self._speed = speed
        self._run: _Run | None = None

    @property
    def waits(self) -> bool:
        """Whether it goes on only when what it sent was taken, and nothing needs to be dropped."""
        return self._speed is None

    @property
    def description(self) -> DeviceDescription:
        """What the recorded device is, under the name here; valid after ``open``.

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
        self._run = _Run(RecordingReader(self._path))

    def close(self) -> None:
        """End ``frames`` at once and close the file; may be called from any thread, and twice."""
        if self._run is not None:
            self._run.close()

    def frames(self) -> Iterator[LineFrame]:
        """Yield the frames until the file ends or ``close`` is called.

        Raises:
            InvalidRecording: the stored data are damaged.
            RuntimeError: the driver was never opened.
        """
        return self._play(self._opened())

    def _opened(self) -> "_Run":
        if self._run is None:
            raise RuntimeError("the driver is not open; call open() first")
        return self._run

    def _play(self, run: "_Run") -> Iterator[LineFrame]:
        start_ns = 0
        first_device_ns: int | None = None
        for recorded in run.frames():
            frame = replace(recorded, device=self._name)
            if self._speed is not None:
                if first_device_ns is None:
                    first_device_ns, start_ns = frame.exposure_device_ns, time.monotonic_ns()
                passed_ns = frame.exposure_device_ns - first_device_ns
                due_ns = start_ns + round(passed_ns / self._speed)
                wait_until(due_ns, run.closed)
                frame = replace(frame, exposure_host_ns=host_time_ns(due_ns))
            if run.closed.is_set():
                return
            yield frame


class _Run:
    """One opening of the file: reading and closing exclude one another."""

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
