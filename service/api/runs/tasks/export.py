"""An export run's process: from a recording to a file of another program's format."""

from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

from compute.errors import InvalidParameter
from compute.pose.rigid_body import RigidBody
from service.api.base_models import Position, ResponseModel
from service.api.devices.tracking_settings import Tracking
from service.api.exports.repository import check_space
from service.api.exports.schema import Format
from service.pipeline.active_calibration import ActiveCalibration

MAX_FRAMES: Final = 1_000_000
"""They are held in memory, about half a kilobyte for each point and track in each frame."""
_WRITING: Final = 0.95
"""Share of the progress before the file is written."""
_TELL_FRAMES: Final = 500


class StoredTool(ResponseModel):
    """A tool as it was when the run was posted."""

    name: str
    markers_mm: list[Position]
    strobe_markers: list[int] | None
    tip_mm: Position | None
    max_tip_sd_mm: float | None

    def body(self) -> RigidBody:
        """Return it as what is tracked."""
        return RigidBody(
            self.name,
            np.array(self.markers_mm, dtype=np.float64),
            None if self.strobe_markers is None else tuple(self.strobe_markers),
            self.tip_mm,
            self.max_tip_sd_mm,
        )


class Request(ResponseModel):
    """What a run keeps of its request, with tools and tracking as they were then."""

    recording: str
    format: Format
    result_id: str | None
    tools: list[StoredTool]
    tracking: Tracking
    calibration: str | None
    table: str | None
    predicted: bool
    points: bool


def compute(
    report_progress: Callable[[float, str], None],
    request: Request,
    recording: Path,
    output: Path,
    given: ActiveCalibration | None,
    free_bytes: int,
) -> None:
    """Follow markers and tools through a recording and write the file.

    Raises:
        InvalidRecording: it cannot be read, or holds no calibration and none is given.
        InvalidParameter: it is too long, or has nothing that the format holds.
        MissingLibrary: the format needs a library that is not installed.
        InsufficientStorage: the disk is full, or would be.
    """
    from hardware.recording.reader import RecordingReader
    from service.api.exports.formats import write_export
    from service.api.exports.from_recording import table_from_recording

    with RecordingReader(recording) as reader:
        frames = reader.info.frames
        check_length(request.recording, frames)
        told = -_TELL_FRAMES

        def done(count: int) -> None:
            nonlocal told
            if count - told >= _TELL_FRAMES:
                told = count
                report_progress(_WRITING * count / max(frames, 1), f"frame {count} of {frames}")

        tools = [tool.body() for tool in request.tools]
        table = table_from_recording(reader, tools, given, done, request.tracking)
    report_progress(_WRITING, "writes the file")
    check_space(output.parent, free_bytes)
    output.unlink(missing_ok=True)
    write_export(table, output, predicted=request.predicted, points=request.points)
    check_space(output.parent, free_bytes)


def check_length(recording: str, frames: int) -> None:
    """Raise InvalidParameter when a recording is longer than runs export."""
    if frames > MAX_FRAMES:
        raise InvalidParameter(
            f'recording "{recording}" has {frames} frames; {MAX_FRAMES} are the most that are '
            "exported here: `lumiline export` does it where it lies",
            frames=frames,
        )
