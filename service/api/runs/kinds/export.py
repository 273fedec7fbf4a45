"""Export runs: a recording in, a file of another program's format out."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from compute.errors import InvalidParameter
from compute.pose.rigid_body import RigidBody
from service.api.base_models import Position, ResponseModel, from_attributes
from service.api.calibrations.calibration_content import result_of
from service.api.devices.driver_factory import recording_path
from service.api.devices.tracking_settings import Tracking
from service.api.exports.repository import ExportRepository, check_space
from service.api.exports.schema import Format, NewExportRun
from service.pipeline.active_calibration import ActiveCalibration

if TYPE_CHECKING:
    from sqlalchemy.orm import Session

    from service.database.models import DeviceRow, RunRow, ToolRow
    from service.pipeline.detection_stage import FindProfile

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
        """Return the tool as a rigid body."""
        return RigidBody(
            self.name,
            np.array(self.markers_mm, dtype=np.float64),
            None if self.strobe_markers is None else tuple(self.strobe_markers),
            self.tip_mm,
            self.max_tip_sd_mm,
        )


class Request(ResponseModel):
    """Stored request of an export run, with tools and tracking as they were then."""

    recording_id: str
    format: Format
    result_id: str | None
    tools: list[StoredTool]
    tracking: Tracking
    calibration_id: str | None
    table_id: str | None
    predicted: bool
    points: bool


def request_of(session: "Session", device: "DeviceRow", request: NewExportRun) -> dict[str, Any]:
    """Return the request as it is stored, with the device's tools and tracking as they are now.

    Raises:
        UnknownTool, UnknownCalibration, UnknownCorrectionTable: as they say.
        InvalidParameter: a tool is another device's, or a table of another calibration.
    """
    from service.api.devices.store import tracking_of

    kept = from_attributes(
        Request,
        request,
        tools=[_kept(row) for row in _tools(session, device.id, request.tool_ids)],
        tracking=tracking_of(device),
    )
    _check_given(session, kept)
    return kept.model_dump(mode="json")


def task(
    exports: ExportRepository,
    recordings: Path,
    find_profile: "FindProfile",
    session: "Session",
    row: "RunRow",
) -> tuple[Callable[..., Any], tuple[Any, ...]]:
    """Return what the run's process calls, with its arguments.

    Args:
        exports: where the file is to lie.
        recordings: the folder of recordings.
        find_profile: returns the device profiles that recordings name; can be pickled.
        session: the session.
        row: of the run.

    Raises:
        UnknownRecording, UnknownCalibration, UnknownCorrectionTable: deleted meanwhile.
    """
    request = Request.model_validate(row.request)
    recording = recording_path(request.recording_id, recordings)
    output = exports.partial_path(row.id, request.format)
    given = _given(session, request)
    return compute, (request, recording, output, given, exports.free_bytes, find_profile)


def store(exports: ExportRepository, _session: "Session", row: "RunRow", _result: None) -> str:
    """Keep the file and return its id; raises ExportExists when the id was taken meanwhile."""
    request = Request.model_validate(row.request)
    export_id = request.result_id or row.id
    exports.publish(row.id, request.format, export_id)
    return export_id


def _tools(session: "Session", device_id: str, wanted: list[str] | None) -> "list[ToolRow]":
    from sqlalchemy import select

    from service.api.tools.store import TOOLS
    from service.database.models import ToolRow

    if wanted is None:
        query = select(ToolRow).where(ToolRow.device_id == device_id).order_by(ToolRow.id)
        return list(session.scalars(query))
    found = [TOOLS.get(session, one) for one in dict.fromkeys(wanted)]
    for row in found:
        if row.device_id != device_id:
            raise InvalidParameter(
                f'tool "{row.id}" is of device "{row.device_id}"; only those of "{device_id}" can '
                "be followed",
                tool_id=row.id,
            )
    return found


def _kept(row: "ToolRow") -> StoredTool:
    from service.api.tools.rigid_bodies import body_of

    return from_attributes(StoredTool, body_of(row), markers_mm=row.markers_mm)


def _check_given(session: "Session", request: Request) -> None:
    from service.api.calibrations.store import get_calibration
    from service.api.correction_tables.store import TABLES

    if request.calibration_id is not None:
        get_calibration(session, request.calibration_id)
    if request.table_id is None:
        return
    if request.calibration_id is None:
        raise InvalidParameter(
            f'table "{request.table_id}" needs its calibration: give that, too',
            table_id=request.table_id,
        )
    parent = TABLES.get(session, request.table_id).calibration_id
    if parent != request.calibration_id:
        raise InvalidParameter(
            f'table "{request.table_id}" is of calibration "{parent}", not of '
            f'"{request.calibration_id}"',
            table_id=request.table_id,
        )


def _given(session: "Session", request: Request) -> ActiveCalibration | None:
    from service.api.calibrations.store import get_calibration
    from service.api.correction_tables.store import TABLES, content_of

    if request.calibration_id is None:
        return None
    calibration = get_calibration(session, request.calibration_id)
    table = None
    if request.table_id is not None:
        table = content_of(TABLES.get(session, request.table_id)).table
    return ActiveCalibration(
        calibration.id, result_of(calibration.content), request.table_id, table
    )


def compute(
    report_progress: Callable[[float, str], None],
    request: Request,
    recording: Path,
    output: Path,
    given: ActiveCalibration | None,
    free_bytes: int,
    find_profile: "FindProfile",
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
        check_length(request.recording_id, frames)
        told = -_TELL_FRAMES

        def done(count: int) -> None:
            nonlocal told
            if count - told >= _TELL_FRAMES:
                told = count
                report_progress(_WRITING * count / max(frames, 1), f"frame {count} of {frames}")

        tools = [tool.body() for tool in request.tools]
        table = table_from_recording(reader, tools, given, done, request.tracking, find_profile)
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
