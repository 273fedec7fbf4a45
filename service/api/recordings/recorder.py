"""Recorder: passes the batches of a running device to the process that writes the file."""

from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any, Final

import numpy as np

from hardware.recording.frame_block import frame_rows, scan_shape
from hardware.recording.layout import NO_CALIBRATION_ROW, PEAK, point_dtype
from hardware.recording.writer_process.client import WriterProcessClient
from hardware.recording.writer_process.job import WriterJob, WriterStatus
from service.api.recordings.active_calibration_file import dump_active_calibration
from service.api.recordings.result_rows import peak_rows, point_rows
from service.api.recordings.schema import NewRecording
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.frame_batch import FrameBatch
from service.pipeline.interface import RunningDevice
from service.version import package_version


class Recorder:
    """A tap of a device's session, from its first frame to the end of the file.

    Args:
        job: what is recorded.
        session: of the device.

    Raises:
        OSError: the file cannot be made.
    """

    def __init__(self, job: WriterJob, session: RunningDevice) -> None:
        self.job = job
        self.session = session
        self._feed = WriterProcessClient(job)
        self._lock = Lock()
        self._rows: dict[ActiveCalibration, int] = {}
        self._active_row = NO_CALIBRATION_ROW
        self._dropped_before = session.frames_dropped
        sensors = len(session.description.sensors)
        self._nothing = np.empty(0, PEAK), np.empty(0, point_dtype(sensors))

    @property
    def wants_pixels(self) -> bool:
        """Whether scans are recorded."""
        return self.job.lines

    @property
    def status(self) -> WriterStatus:
        """Frames safe in the file, its size, and why it ended; None: it goes on."""
        return self._feed.status

    @property
    def dropped_frames(self) -> int:
        """Frames dropped because the writer did not keep up, until now."""
        return self._feed.dropped_frames

    def prepare(self, found: ActiveCalibration) -> None:
        """Have a calibration and its table brought to the file, before the frames of them."""
        self._active_row = self._row(found)

    def offer(self, batch: FrameBatch) -> None:
        """Hand a batch over; it is dropped and counted when the writer is behind. Never waits."""
        if self._feed.ended:
            return
        try:
            self._hand_over(batch)
        except Exception as error:
            self.stop(f"frames could not be handed over: {type(error).__name__}: {error}")
            raise

    def _hand_over(self, batch: FrameBatch) -> None:
        rows = frame_rows(batch.frames)
        rows["active_calibration"] = self._active_row
        peaks, points = self._nothing
        if self.job.results:
            sensors = len(batch.sensor_names)
            peaks, rows["peaks"] = peak_rows(batch.peaks, sensors)
            points, rows["points"] = point_rows(batch)
        lines = [frame.lines for frame in batch.frames]
        dropped = self.session.frames_dropped - self._dropped_before
        self._feed.put(rows, lines, peaks, points, dropped)

    def stop(self, reason: str) -> None:
        """Let the file be written to its end and closed; does not wait for it.

        A writer that does not come to its end is killed after a minute.
        """
        self._feed.stop(reason)

    def wait(self, timeout_s: float) -> bool:
        """Wait for the end, at most this long; return whether it has ended."""
        return self._feed.wait(timeout_s)

    def _row(self, found: ActiveCalibration) -> int:
        """Return the row of the active calibration; a new one is sent from another thread."""
        if found.calibration is None and found.radiometric is None and not found.bad_pixels:
            return NO_CALIBRATION_ROW
        with self._lock:
            row = self._rows.get(found)
            if row is None:
                row = self._rows[found] = self._feed.put_active_calibration(
                    partial(dump_active_calibration, found)
                )
            return row


@dataclass(frozen=True)
class WriteCounters:
    """Recording counters of a device.

    Args:
        open: recordings that are being written.
        frames_written: frames that are safe in files.
        frames_dropped_writer: frames that the writer did not keep up with.
        size_bytes: of the files.
        failed: recordings that could not be written any more.
    """

    open: int = 0
    frames_written: int = 0
    frames_dropped_writer: int = 0
    size_bytes: int = 0
    failed: int = 0

    def with_recorder(self, recorder: Recorder) -> "WriteCounters":
        """Return this and what a recorder has written."""
        return replace(
            self,
            open=self.open + (recorder.status.ended is None),
            frames_written=self.frames_written + recorder.status.state.frames,
            frames_dropped_writer=self.frames_dropped_writer + recorder.dropped_frames,
            size_bytes=self.size_bytes + recorder.status.size_bytes,
            failed=self.failed + recorder.status.failed,
        )


RING_SECONDS: Final = 1.5
MIN_RING_BYTES: Final = 2**23
MAX_RING_BYTES: Final = 2**28
_UNKNOWN_HZ: Final = 1000.0


def writer_job(
    session: RunningDevice,
    request: NewRecording,
    path: Path,
    begin: datetime,
    free_bytes: int,
    flush_s: float,
) -> WriterJob:
    """Return the job of a recording.

    Args:
        session: of the device.
        request: what a client asked for.
        path: the file.
        begin: when it was asked for.
        free_bytes: what has to stay free on the disk.
        flush_s: how often it is flushed [s].
    """
    return WriterJob(
        path=path,
        description=session.description,
        lines="lines" in request.contents,
        results="results" in request.contents,
        provenance=_provenance(session, request, begin),
        seconds=request.max_duration_s,
        size_bytes=request.max_size_bytes,
        free_bytes=free_bytes,
        flush_s=flush_s,
        ring_bytes=_ring_bytes(session),
    )


def _provenance(session: RunningDevice, request: NewRecording, begin: datetime) -> dict[str, Any]:
    """Return the provenance of results: software versions and settings."""
    return {
        "program": "lumiline",
        "version": package_version(),
        "started_at": begin.isoformat(),
        "request": request.model_dump(mode="json"),
        "peaks": session.peak_settings(),
    }


def _ring_bytes(session: RunningDevice) -> int:
    sensors, pixels = scan_shape(session.description)
    rate = session.description.frame_rate_hz or _UNKNOWN_HZ
    wanted = int(RING_SECONDS * rate * sensors * pixels * 2)
    return max(MIN_RING_BYTES, min(MAX_RING_BYTES, wanted)) // 64 * 64
