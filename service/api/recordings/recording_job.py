"""RecordingJob of a running device: what its writer process is told."""

from datetime import datetime
from pathlib import Path
from typing import Any, Final

from hardware.recording.frame_block import scan_shape
from hardware.recording.writer_process.job import WriterJob
from service.api.recordings.schema import NewRecording
from service.pipeline.device_session import DeviceSession
from service.version import package_version

RING_SECONDS: Final = 1.5
MIN_RING_BYTES: Final = 2**23
MAX_RING_BYTES: Final = 2**28
_UNKNOWN_HZ: Final = 1000.0


def writer_job(
    session: DeviceSession,
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
        seconds=request.seconds,
        size_bytes=request.size_bytes,
        free_bytes=free_bytes,
        flush_s=flush_s,
        ring_bytes=_ring_bytes(session),
    )


def _provenance(session: DeviceSession, request: NewRecording, begin: datetime) -> dict[str, Any]:
    """Return the provenance of results: software versions and settings."""
    return {
        "program": "lumiline",
        "version": package_version(),
        "started_at": begin.isoformat(),
        "request": request.model_dump(mode="json"),
        "peaks": session.processor.detection.settings(),
    }


def _ring_bytes(session: DeviceSession) -> int:
    sensors, pixels = scan_shape(session.description)
    rate = session.description.frame_rate_hz or _UNKNOWN_HZ
    wanted = int(RING_SECONDS * rate * sensors * pixels * 2)
    return max(MIN_RING_BYTES, min(MAX_RING_BYTES, wanted)) // 64 * 64
