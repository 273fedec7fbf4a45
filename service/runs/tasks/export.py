"""An export run's process: from a recording to a file of another program's format."""

from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

from compute.errors import InvalidParameter
from compute.pose.rigid_body import RigidBody
from service.devices.tracking import Tracking
from service.exports.library import check_space
from service.exports.schema import Format
from service.live.in_force import InForce
from service.schema import Document, Position

MOST_FRAMES: Final = 1_000_000
"""They are held in memory, about half a kilobyte for each point and track in each frame."""
_WRITING: Final = 0.95
"""Share of the progress before the file is written."""
_TELL_FRAMES: Final = 500


class KeptTool(Document):
    """A tool as it was when the run was posted."""

    name: str
    markers_mm: list[Position]
    strobe_markers: list[int] | None
    tip_mm: Position | None
    most_tip_sd_mm: float | None

    def body(self) -> RigidBody:
        """Return it as what is tracked."""
        return RigidBody(
            self.name,
            np.array(self.markers_mm, dtype=np.float64),
            None if self.strobe_markers is None else tuple(self.strobe_markers),
            self.tip_mm,
            self.most_tip_sd_mm,
        )


class Request(Document):
    """What a run keeps of its request, with tools and tracking as they were then."""

    recording: str
    format: Format
    result_id: str | None
    tools: list[KeptTool]
    tracking: Tracking
    calibration: str | None
    table: str | None
    predicted: bool
    points: bool


def compute(
    tell: Callable[[float, str], None],
    request: Request,
    recording: Path,
    output: Path,
    given: InForce | None,
    free_bytes: int,
) -> None:
    """Follow markers and tools through a recording and write the file.

    Raises:
        InvalidRecording: it cannot be read, or holds no calibration and none is given.
        InvalidParameter: it is too long, or has nothing that the format holds.
        MissingLibrary: the format needs a library that is not installed.
        InsufficientStorage: the disk is full, or would be.
    """
    from hardware.recording_reader import RecordingReader
    from service.exports.formats import write_export
    from service.exports.recorded import recorded_table

    with RecordingReader(recording) as reader:
        frames = reader.info.frames
        check_length(request.recording, frames)
        told = -_TELL_FRAMES

        def done(count: int) -> None:
            nonlocal told
            if count - told >= _TELL_FRAMES:
                told = count
                tell(_WRITING * count / max(frames, 1), f"frame {count} of {frames}")

        tools = [tool.body() for tool in request.tools]
        table = recorded_table(reader, tools, given, done, request.tracking)
    tell(_WRITING, "writes the file")
    check_space(output.parent, free_bytes)
    output.unlink(missing_ok=True)
    write_export(table, output, predicted=request.predicted, points=request.points)
    check_space(output.parent, free_bytes)


def check_length(recording: str, frames: int) -> None:
    """Raise InvalidParameter when a recording is longer than runs export."""
    if frames > MOST_FRAMES:
        raise InvalidParameter(
            f'recording "{recording}" has {frames} frames; {MOST_FRAMES} are the most that are '
            "exported here: `lumiline export` does it where it lies",
            frames=frames,
        )
