"""Export runs: checked when posted, their file kept when done."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from compute.errors import InvalidParameter
from service.api.calibrations.calibration_content import result_of
from service.api.calibrations.store import get_calibration
from service.api.correction_tables.store import content_of, get_table
from service.api.devices.driver_factory import recording_path
from service.api.devices.store import tracking_of
from service.api.exports.repository import ExportRepository
from service.api.exports.schema import NewExportRun
from service.api.runs.tasks.export import Request, StoredTool, compute
from service.api.tools.rigid_bodies import body_of
from service.api.tools.store import get_tool
from service.database.models import DeviceRow, RunRow, ToolRow
from service.pipeline.active_calibration import ActiveCalibration


def request_of(session: Session, device: DeviceRow, request: NewExportRun) -> dict[str, Any]:
    """Return the request as it is stored, with the device's tools and tracking as they are now.

    Raises:
        UnknownTool, UnknownCalibration, UnknownCorrectionTable: as they say.
        InvalidParameter: a tool is another device's, or a table of another calibration.
    """
    kept = Request(
        recording=request.recording,
        format=request.format,
        result_id=request.result_id,
        tools=[_kept(row) for row in _tools(session, device.id, request.tools)],
        tracking=tracking_of(device),
        calibration=request.calibration,
        table=request.table,
        predicted=request.predicted,
        points=request.points,
    )
    _check_given(session, kept)
    return kept.model_dump(mode="json")


def task(
    exports: ExportRepository, recordings: Path, session: Session, row: RunRow
) -> tuple[Callable[..., Any], tuple[Any, ...]]:
    """Return what the run's process calls, with its arguments.

    Args:
        exports: where the file is to lie.
        recordings: the folder of recordings.
        session: the session.
        row: of the run.

    Raises:
        UnknownRecording, UnknownCalibration, UnknownCorrectionTable: deleted meanwhile.
    """
    request = Request.model_validate(row.request)
    recording = recording_path(request.recording, recordings)
    output = exports.partial_path(row.id, request.format)
    given = _given(session, request)
    return compute, (request, recording, output, given, exports.free_bytes)


def store(exports: ExportRepository, _session: Session, row: RunRow, _result: None) -> str:
    """Keep the file and return its id; raises ExportExists when the id was taken meanwhile."""
    request = Request.model_validate(row.request)
    export_id = request.result_id or row.id
    exports.publish(row.id, request.format, export_id)
    return export_id


def _tools(session: Session, device_id: str, wanted: list[str] | None) -> list[ToolRow]:
    if wanted is None:
        query = select(ToolRow).where(ToolRow.device_id == device_id).order_by(ToolRow.id)
        return list(session.scalars(query))
    found = [get_tool(session, one) for one in dict.fromkeys(wanted)]
    for row in found:
        if row.device_id != device_id:
            raise InvalidParameter(
                f'tool "{row.id}" is of device "{row.device_id}"; only those of "{device_id}" can '
                "be followed",
                tool=row.id,
            )
    return found


def _kept(row: ToolRow) -> StoredTool:
    body = body_of(row)
    return StoredTool(
        name=body.name,
        markers_mm=row.markers_mm,
        strobe_markers=row.strobe_markers,
        tip_mm=body.tip_mm,
        max_tip_sd_mm=body.max_tip_sd_mm,
    )


def _check_given(session: Session, request: Request) -> None:
    if request.calibration is not None:
        get_calibration(session, request.calibration)
    if request.table is None:
        return
    if request.calibration is None:
        raise InvalidParameter(
            f'table "{request.table}" needs its calibration: give that, too', table=request.table
        )
    parent = get_table(session, request.table).calibration_id
    if parent != request.calibration:
        raise InvalidParameter(
            f'table "{request.table}" is of calibration "{parent}", not of "{request.calibration}"',
            table=request.table,
        )


def _given(session: Session, request: Request) -> ActiveCalibration | None:
    if request.calibration is None:
        return None
    calibration = get_calibration(session, request.calibration)
    table = None
    if request.table is not None:
        table = content_of(get_table(session, request.table)).table
    return ActiveCalibration(calibration.id, result_of(calibration.content), request.table, table)
