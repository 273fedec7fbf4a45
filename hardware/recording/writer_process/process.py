"""The writer process: reads frame blocks from a shared ring and writes them to a file.

Started by ``hardware.recording.writer_process.client``, with the descriptors of the ring's memory
and of the pipe of heads as arguments; its standard input carries the job and the calibrations, its
standard output the status. When its parent dies it writes what the ring holds and closes the file
as incomplete.
"""

import os
import re
import select
import signal
import sys
import time
from contextlib import suppress
from queue import Empty, SimpleQueue
from threading import Thread
from typing import BinaryIO, Final

from compute.errors import LumilineError
from hardware.recording.frame_block import FrameBlock, scan_shape
from hardware.recording.layout import NO_LOSSES, Losses, RecordingState
from hardware.recording.writer import RecordingWriter
from hardware.recording.writer_process.job import DOCUMENT, HEAD, JOB, WriterJob, WriterStatus
from hardware.recording.writer_process.shared_ring import RingShape, SharedBlockRing

ORPHANED: Final = "the program that recorded ended without closing the recording"
_MAX_HEADERS: Final = 1024
"""Maximum number of head messages read at once; only the last one counts."""
_REASON_S: Final = 5.0
_PAUSE_S: Final = 0.025
"""Pause between reads of the ring: waking for each block would cost more than writing it."""


class _Documents:
    """Reads calibrations, tables and the reason of the stop in a separate thread."""

    def __init__(self, source: BinaryIO) -> None:
        self._source = source
        self._queue: SimpleQueue[tuple[bytes, bytes] | None] = SimpleQueue()
        self.reason: SimpleQueue[str] = SimpleQueue()
        Thread(target=self._read, daemon=True).start()

    def next(self) -> tuple[bytes, bytes] | None:
        """Return the next calibration and table; None: there are no more."""
        return self._queue.get()

    def _read(self) -> None:
        while len(head := self._source.read(DOCUMENT.size)) == DOCUMENT.size:
            first, second = DOCUMENT.unpack(head)
            if first < 0:
                self.reason.put(self._source.read(second).decode(errors="replace"))
                break
            document, table = self._source.read(first), self._source.read(second)
            if (len(document), len(table)) != (first, second):
                break  # whoever sent it has ended meanwhile
            self._queue.put((document, table))
        self._queue.put(None)


class _Recording:
    """One recording, from its first block to its end."""

    def __init__(self, job: WriterJob, ring: SharedBlockRing, documents: _Documents) -> None:
        self._job = job
        self._ring = ring
        self._documents = documents
        self._calibrations = 0
        self._begin_ns: int | None = None
        self._bytes = 0
        self._refused = 0
        self._losses = NO_LOSSES
        self.ended: str | None = None
        self.writer = RecordingWriter(
            job.path,
            job.description,
            lines=job.lines,
            results=job.results,
            provenance=job.provenance,
            exclusive=True,
        )

    @property
    def losses(self) -> Losses:
        """Frames lost until now, in the writer and before it."""
        lost = self._losses
        return Losses(lost.dropped_compute, lost.dropped_writer, lost.refused + self._refused)

    def take(self, head: int) -> None:
        """Write the ring's blocks up to ``head``, or up to a limit of the job."""
        for block, losses in self._ring.take(head):
            if self.ended is None:
                self._losses = losses
                self._write(block)

    def add_losses(self, losses: Losses) -> None:
        """Record losses after the last block."""
        self._losses = losses

    def stop(self) -> None:
        """End the recording with the parent's reason."""
        self.ended = "stopped"
        with suppress(Empty):
            self.ended = self._documents.reason.get(timeout=_REASON_S)

    def status(self, *, failed: bool = False) -> WriterStatus:
        """Return the status for the parent."""
        with suppress(OSError):
            self._bytes = max(self._bytes, self._job.path.stat().st_size)
        return WriterStatus(self._ring.tail, self._bytes, self.writer.state, self.ended, failed)

    def check_disk(self) -> None:
        """End the recording while there is still disk space to close the file."""
        if self.ended is None:
            disk = os.statvfs(self._job.path.parent)
            free = disk.f_bavail * disk.f_frsize
            if free < self._job.free_bytes:
                self.ended = (
                    f"free space: {free} bytes are left on the disk; the limit is "
                    f"{self._job.free_bytes}"
                )

    def _write(self, block: FrameBlock) -> None:
        job = self._job
        if job.seconds is not None and len(block.rows):
            times = block.rows["exposure_device_ns"]
            if self._begin_ns is None:
                self._begin_ns = int(times[0])
            inside = times - self._begin_ns < round(job.seconds * 1e9)
            if not inside.all():
                self.ended = f"the limit of {job.seconds:g} s"
                block = block.select(inside)
        while self._calibrations <= int(block.rows["active_calibration"].max(initial=-1)):
            documents = self._documents.next()
            if documents is None:
                self.ended = ORPHANED
                return
            self.writer.put_active_calibration(*documents)
            self._calibrations += 1
        self._refused += self.writer.append_block(block)
        self._bytes += sum(
            part.nbytes for part in (block.rows, block.lines, block.peaks, block.points)
            if part is not None
        )  # fmt: skip
        if job.size_bytes is not None and self._bytes >= job.size_bytes and self.ended is None:
            self.ended = f"the limit of {job.size_bytes} bytes"


def record(ring_descriptor: int, header_pipe: int, source: BinaryIO, target: int) -> None:
    """Record until a stop request, a limit, an error or the parent's end."""
    job: WriterJob = JOB.validate_json(source.readline())
    sensors, pixels = scan_shape(job.description)
    ring = SharedBlockRing(ring_descriptor, RingShape(job.ring_bytes, sensors, pixels, job.lines))
    try:
        recording = _Recording(job, ring, _Documents(source))
    except (OSError, RuntimeError, LumilineError) as error:
        text = f"{job.path.name}: {_reason(error)}"
        _send_status(target, WriterStatus(0, 0, RecordingState(), text, failed=True))
        return
    try:
        _send_status(target, recording.status())
        complete = _receive(recording, job, header_pipe, target)
        recording.writer.close(
            complete=complete, reason=recording.ended or "", losses=recording.losses
        )
    except (OSError, RuntimeError, ValueError) as error:
        # What was flushed is safe as the file lies there; closing it could only spoil it.
        recording.ended = f"the file cannot be written: {_reason(error)}"
        _send_status(target, recording.status(failed=True))
        os._exit(1)
    _send_status(target, recording.status())


def _receive(recording: _Recording, job: WriterJob, header_pipe: int, target: int) -> bool:
    """Write blocks until the end; return whether it was a regular one."""
    flush_at = time.monotonic() + job.flush_s
    while True:
        wait_s = max(0.0, flush_at - time.monotonic())
        newest = None
        if select.select([header_pipe], [], [], wait_s)[0]:
            time.sleep(_PAUSE_S)
            packed = os.read(header_pipe, _MAX_HEADERS * HEAD.size)
            if not packed:
                recording.ended = ORPHANED
                return False
            newest = HEAD.unpack(packed[-HEAD.size :])
            recording.take(newest[0])
        recording.check_disk()
        if recording.ended is not None:
            return recording.ended != ORPHANED
        if newest is not None and newest[1]:
            recording.add_losses(Losses(*newest[2:]))
            recording.stop()
            return True
        if time.monotonic() >= flush_at:
            recording.writer.flush(recording.losses)
            flush_at = time.monotonic() + job.flush_s
        _send_status(target, recording.status())


def _send_status(target: int, status: WriterStatus) -> None:
    with suppress(BrokenPipeError):
        os.write(target, status.dumps())


def _reason(error: Exception) -> str:
    """Return an error message of one line."""
    if isinstance(error, LumilineError):
        return error.detail
    if isinstance(error, OSError) and error.errno:
        return os.strerror(error.errno)
    # The file library tells the system's reason among addresses, behind its first line.
    match = re.search(r"error message = '([^']+)'", str(error))
    if match is not None:
        return match[1]
    return (str(error).splitlines() or [type(error).__name__])[0][:200]


def main() -> None:
    """Entry point of the process; it ignores SIGINT, SIGTERM, SIGHUP and ends with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    if hasattr(signal, "SIGHUP"):
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
    record(int(sys.argv[1]), int(sys.argv[2]), sys.stdin.buffer, sys.stdout.fileno())
    os._exit(0)  # the thread that waits for calibrations may do so for ever


if __name__ == "__main__":
    main()
