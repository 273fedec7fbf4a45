"""WriteCounters: what was recorded of one device since the server's start, for its metrics."""

from dataclasses import dataclass, replace

from service.api.recordings.recorder import Recorder


@dataclass(frozen=True)
class WriteCounters:
    """What was recorded of a device.

    Args:
        open: recordings that are being written.
        frames: frames that are safe in files.
        dropped: frames that the writer did not keep up with.
        size_bytes: of the files.
        failed: recordings that could not be written any more.
    """

    open: int = 0
    frames: int = 0
    dropped: int = 0
    size_bytes: int = 0
    failed: int = 0

    def with_recorder(self, recorder: Recorder) -> "WriteCounters":
        """Return this and what a recorder has written."""
        return replace(
            self,
            open=self.open + (recorder.ended is None),
            frames=self.frames + recorder.state.frames,
            dropped=self.dropped + recorder.dropped_frames,
            size_bytes=self.size_bytes + recorder.size_bytes,
            failed=self.failed + recorder.failed,
        )
