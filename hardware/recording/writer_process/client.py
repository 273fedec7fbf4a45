"""WriterProcessClient: starts the writer process of a recording and sends frames to it.

Only the start waits for the writer: where it does not keep up, frames are dropped and counted;
a writer that does not stop when asked is killed. See
docs/decisions/0011-recording.md.
"""

import logging
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from io import BufferedReader, RawIOBase
from queue import SimpleQueue
from threading import Event, Lock, Thread, Timer
from typing import IO, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from hardware.recording.frame_block import scan_shape
from hardware.recording.layout import Losses, RecordingState, unfinished_path
from hardware.recording.writer_process.job import (
    DOCUMENT,
    HEAD,
    WRITER_STATUS,
    WriterJob,
    WriterStatus,
)
from hardware.recording.writer_process.shared_ring import RingShape, SharedBlockRing, make_memory

_log = logging.getLogger(__name__)

START_S: Final = 30.0
STOP_S: Final = 60.0
"""Time limit for closing the file after a stop: 256 MiB at 5 MB/s."""
_RETRY_S: Final = 0.01
WRITER_DIED: Final = "the process that writes it ended; what it had flushed is in the file"
WRITER_LATE: Final = "its writer did not close it within {:g} s; what it had flushed is in the file"


class WriterProcessClient:
    """Starts the writer process and sends frames to it; callable from any thread.

    Args:
        job: what to record.

    Raises:
        OSError: the process cannot be started, or cannot create the file.
    """

    def __init__(self, job: WriterJob) -> None:
        sensors, pixels = scan_shape(job.description)
        self.job = job
        self.status = WriterStatus(0, 0, RecordingState())
        """Status last reported by the writer; final after the end."""
        self.dropped_frames = 0
        """Frames dropped because the writer did not keep up."""
        self._dropped_compute = 0
        self._calibrations = 0
        self._stopping = False
        self._stop_sent = False
        self._died = WRITER_DIED
        self._deadline: Timer | None = None
        # Held for no longer than a copy into the ring: the compute thread takes it.
        self._lock = Lock()
        self._closed = Event()
        self._ready = Event()
        request = job.dumps()
        memory = make_memory(job.ring_bytes)
        read_end, self._header_pipe = os.pipe()
        try:
            self._ring = SharedBlockRing(
                memory, RingShape(job.ring_bytes, sensors, pixels, job.lines)
            )
            self._process = subprocess.Popen(  # noqa: S603 - our own command line
                [
                    sys.executable,
                    "-m",
                    "hardware.recording.writer_process.process",
                    str(memory),
                    str(read_end),
                ],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                pass_fds=(memory, read_end),
                start_new_session=True,
                bufsize=0,
            )
        except BaseException:
            os.close(self._header_pipe)
            raise
        finally:
            os.close(memory)
            os.close(read_end)
        os.set_blocking(self._header_pipe, False)
        name = f"recording-{job.path.name}"
        assert self._process.stdin is not None
        self._sender = PipeSender(self._process.stdin, f"{name}-input", self._cannot_send)
        self._sender.send(lambda: request)
        self._thread = Thread(target=self._listen, name=name, daemon=True)
        self._thread.start()
        if not self._ready.wait(START_S):
            self.kill()
            raise OSError(f"the process that records did not start within {START_S:g} s")
        if self.status.failed:
            self._thread.join()
            raise OSError(self.status.ended)

    @property
    def pid(self) -> int:
        """Id of the process."""
        return self._process.pid

    @property
    def ended(self) -> bool:
        """Whether the file is closed, or given up."""
        return self.status.ended is not None

    def put_active_calibration(self, make: Callable[[], tuple[bytes, bytes]]) -> int:
        """Send a calibration and its table; return its row for the frames. Never waits.

        Args:
            make: returns both, called later in another thread. An error of it ends the recording.
        """

        def packed() -> bytes:
            document, table = make()
            return DOCUMENT.pack(len(document), len(table)) + document + table

        with self._lock:
            self._sender.send(packed)
            self._calibrations += 1
            return self._calibrations - 1

    def put(
        self,
        rows: NDArray[np.void],
        lines: Sequence[NDArray[np.uint16]],
        peaks: NDArray[np.void],
        points: NDArray[np.void],
        dropped_compute: int = 0,
    ) -> bool:
        """Send frames; False where the ring is full and they are dropped. Never waits.

        Args:
            rows, peaks, points: as of FrameBlock.
            lines: of each frame, shape (S, P).
            dropped_compute: frames that were dropped before they came here, in all.
        """
        with self._lock:
            if self.ended or self._stopping:
                return False
            self._dropped_compute = dropped_compute
            self._ring.tail = max(self._ring.tail, self.status.tail)
            accepted = self._ring.put(rows, lines, peaks, points, self._losses())
            if not accepted:
                self.dropped_frames += len(rows)
        # The newest head counts: that one finds the pipe full does no harm.
        self._send_head()
        return accepted

    def stop(self, reason: str) -> None:
        """Request that the writer finish and close the file; does not wait for it.

        It is killed after STOP_S.
        """
        text = reason.encode()
        with self._lock:
            if self._stopping or self._closed.is_set():
                return
            self._stopping = True
            # The reason first: the writer looks for it when it is told to stop.
            self._sender.send(lambda: DOCUMENT.pack(-1, len(text)) + text, self._send_stop)
            self._deadline = Timer(STOP_S, self._give_up)
            self._deadline.daemon = True
            self._deadline.start()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait at most ``timeout_s`` for the end; return whether it has ended."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def kill(self) -> None:
        """End the process at once; the file holds what was flushed."""
        self._process.kill()

    def _losses(self) -> Losses:
        return Losses(self._dropped_compute, self.dropped_frames, 0)

    def _send_stop(self) -> None:
        """Send the stop request as soon as the pipe of heads has room."""
        with self._lock:
            self._stop_sent = True
        while not self._send_head() and not self._closed.wait(_RETRY_S):
            pass

    def _give_up(self) -> None:
        """Kill a writer that did not stop in time."""
        _log.error("recording %s: its process did not stop within %g s", self.job.path.name, STOP_S)
        self._died = WRITER_LATE.format(STOP_S)
        self.kill()

    def _cannot_send(self, error: Exception) -> None:
        """Kill the writer, which would wait for a calibration that cannot be sent."""
        name = self.job.path.name
        _log.error("recording %s: the active calibration cannot be kept", name, exc_info=error)
        self._died = f"the active calibration cannot be kept: {type(error).__name__}: {error}"
        self.kill()

    def _send_head(self) -> bool:
        """Send the ring's head; False where the pipe is full."""
        with self._lock:
            if self._closed.is_set():
                return True
            lost = vars(self._losses()).values()
            try:
                os.write(self._header_pipe, HEAD.pack(self._ring.head, int(self._stop_sent), *lost))
            except BlockingIOError:
                return False
            except BrokenPipeError:
                return True
        return True

    def _listen(self) -> None:
        """Receive the process's status messages until it ends."""
        assert isinstance(self._process.stdout, RawIOBase)
        with BufferedReader(self._process.stdout) as output:
            for line in output:
                try:
                    self.status = WRITER_STATUS.validate_json(line)
                except ValidationError:
                    _log.warning("recording %s: its process sent %r", self.job.path.name, line)
                self._ready.set()
        code = self._process.wait()
        if self.status.ended is None:
            _log.error("recording %s: its process ended (%d)", self.job.path.name, code)
            self.status = WriterStatus(
                self.status.tail, self.status.size_bytes, self.status.state, self._died, failed=True
            )
        # Of a writer that was killed before its file had its name.
        with suppress(OSError):
            unfinished_path(self.job.path, self.pid).unlink(missing_ok=True)
        self._ready.set()
        with self._lock:
            self._closed.set()
            os.close(self._header_pipe)
            if self._deadline is not None:
                self._deadline.cancel()
        self._sender.close()


_Message = tuple[Callable[[], bytes], Callable[[], None] | None]


class PipeSender:
    """Creates messages and writes them to a pipe in order, in a thread of its own.

    A stalled writer reads nothing, and no other thread may wait for it.

    Args:
        target: the process's input, without a buffer; it is closed at the end.
        name: of the thread.
        failed: called, in the thread, with the error of a message that could not be created;
            nothing is sent after it.
    """

    def __init__(self, target: IO[bytes], name: str, failed: Callable[[Exception], None]) -> None:
        self._target = target
        self._failed = failed
        self._waiting: SimpleQueue[_Message | None] = SimpleQueue()
        Thread(target=self._run, name=name, daemon=True).start()

    def send(self, make: Callable[[], bytes], then: Callable[[], None] | None = None) -> None:
        """Queue the message that ``make`` returns; call ``then`` once it is sent. Never waits.

        Both are called in the sender's thread; neither is when the process has ended.
        """
        self._waiting.put((make, then))

    def close(self) -> None:
        """End the thread after the queued messages. Does not wait for it."""
        self._waiting.put(None)

    def _run(self) -> None:
        try:
            while (entry := self._waiting.get()) is not None:
                make, then = entry
                try:
                    data = make()
                except Exception as error:  # noqa: BLE001 - reported to the client, which ends it
                    self._failed(error)
                    return
                view = memoryview(data)
                while view:
                    view = view[self._target.write(view) or 0 :]
                if then is not None:
                    then()
        except BrokenPipeError:
            pass  # the process has ended, and its end tells why
        finally:
            self._target.close()
