"""WriterJob and WriterStatus: the messages between the writer process and its parent."""

import json
import struct
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from pydantic import TypeAdapter

from hardware.driver import DeviceDescription
from hardware.recording.layout import RecordingState

HEAD: Final = struct.Struct("<qqqqq")
"""To the writer: the ring's head, 1 to stop (0: go on), and Losses. The newest counts."""
DOCUMENT: Final = struct.Struct("<qq")
"""To the writer, before a calibration and its table: their sizes. A size of -1 for the first
stands before the reason of a stop."""


@dataclass(frozen=True)
class WriterJob:
    """A recording to write: file, device, contents and limits.

    Args:
        path: the file; it must not exist.
        description: the device.
        lines: whether lines are recorded.
        results: whether peaks and points are.
        provenance: a JSON object that is kept with the file.
        seconds: maximum duration on the device's clock [s]; None: no limit.
        size_bytes: approximate maximum size of the file [bytes]; None: no limit.
        free_bytes: disk space that must stay free [bytes].
        flush_s: time between flushes [s].
        ring_bytes: size of the ring.
    """

    path: Path
    description: DeviceDescription
    lines: bool
    results: bool
    provenance: dict[str, Any]
    seconds: float | None = None
    size_bytes: int | None = None
    free_bytes: int = 0
    flush_s: float = 1.0
    ring_bytes: int = 2**27

    def dumps(self) -> bytes:
        """Return it as one line of JSON."""
        return json.dumps(asdict(self), default=str).encode() + b"\n"


JOB: Final = TypeAdapter(WriterJob)


@dataclass(frozen=True)
class WriterStatus:
    """Status of the writer, sent as one JSON object per line.

    Args:
        tail: bytes of the ring that are free again, counted from the beginning.
        size_bytes: of the file.
        state: what is safe in the file.
        ended: reason of its end; None: it is running.
        failed: whether an error ended it.
    """

    tail: int
    size_bytes: int
    state: RecordingState
    ended: str | None = None
    failed: bool = False

    def dumps(self) -> bytes:
        """Return it as one line of JSON."""
        return json.dumps(asdict(self)).encode() + b"\n"


WRITER_STATUS: Final = TypeAdapter(WriterStatus)
