"""REST resources /api/v1/export-runs and /api/v1/exports."""

from typing import Annotated, Any

from fastapi import APIRouter, Body, Path
from sqlalchemy import select
from sqlalchemy.orm import Session
from starlette.responses import FileResponse
from starlette.status import HTTP_202_ACCEPTED, HTTP_204_NO_CONTENT

from compute.errors import InvalidParameter
from service.api.base_models import SLUG_PATTERN, Page
from service.api.dependencies import DatabaseDep, ExportsDep, RecordingsDep
from service.api.exports.examples import EXPORT_IDS, NEW_EXPORT_RUNS
from service.api.exports.repository import MEDIA_TYPES
from service.api.exports.schema import Export, ExportFile, NewExportRun
from service.api.json_body import JsonRoute, JsonTypes
from service.api.openapi import problems
from service.api.request_parameters import Limit, Offset
from service.api.runs.kinds import export
from service.api.runs.schema import Run
from service.api.runs.submission import SubmissionDep
from service.api.runs.tasks.export import check_length
from service.database.models import DeviceRow, RunRow
from service.problems.errors import (
    Busy,
    ExportExists,
    InsufficientStorage,
    RecordingInProgress,
    RunExists,
    UnknownCalibration,
    UnknownCorrectionTable,
    UnknownDevice,
    UnknownExport,
    UnknownRecording,
    UnknownTool,
)

router = APIRouter(prefix="/api/v1", tags=["recordings"], route_class=JsonRoute)

_BINARY = {"schema": {"type": "string", "format": "binary"}}
_FILE = dict.fromkeys(dict.fromkeys(MEDIA_TYPES.values()), _BINARY)
NewExportRunBody = Annotated[NewExportRun, JsonTypes(), Body(openapi_examples=NEW_EXPORT_RUNS)]
ExportPath = Annotated[
    str,
    Path(pattern=SLUG_PATTERN, description="The export's id.", openapi_examples=EXPORT_IDS),
]


@router.post(
    "/export-runs",
    operation_id="create-export-run",
    summary="Export a recording beside the requests",
    status_code=HTTP_202_ACCEPTED,
    responses=problems(
        UnknownDevice,
        UnknownRecording,
        UnknownTool,
        UnknownCalibration,
        UnknownCorrectionTable,
        RunExists,
        ExportExists,
        RecordingInProgress,
        InvalidParameter,
        InsufficientStorage,
        Busy,
    ),
)
def create_export_run(
    request: NewExportRunBody,
    acceptance: SubmissionDep,
    recordings: RecordingsDep,
    exports: ExportsDep,
) -> Run:
    """Follow markers and tools through a recording, in a process of its own, and write a file.

    Follow the run at the header `Location`; when it has succeeded, its `result` is the export, and
    `result` with `/file` behind it the file. A calibration that is not the recording's makes its
    points, tracks and poses anew.
    """
    recordings.finished_path(request.recording)
    frames = recordings.get(request.recording).frames
    if frames is not None:
        check_length(request.recording, frames)
    exports.check_space()

    def stored(session: Session, device: DeviceRow) -> dict[str, Any]:
        exports.check_unused(request.result_id)
        return export.request_of(session, device, request)

    return acceptance.run("export", request, stored)


@router.get("/exports", operation_id="list-exports", summary="List exports")
def list_exports(
    exports: ExportsDep, database: DatabaseDep, limit: Limit = 50, offset: Offset = 0
) -> Page[Export]:
    """Files that export runs have made and nobody has deleted, the newest first."""
    found = exports.all()
    with database.read() as session:
        items = [_with_run(session, one) for one in found[offset : offset + limit]]
    return Page(items=items, total=len(found), limit=limit, offset=offset)


@router.get(
    "/exports/{export_id}",
    operation_id="get-export",
    summary="Read about an export",
    responses=problems(UnknownExport),
)
def get_export(export_id: ExportPath, exports: ExportsDep, database: DatabaseDep) -> Export:
    """What an export is of, its format and its size."""
    _, found = exports.find(export_id)
    with database.read() as session:
        return _with_run(session, found)


@router.get(
    "/exports/{export_id}/file",
    operation_id="download-export",
    summary="Download an export",
    response_class=FileResponse,
    responses=problems(UnknownExport)
    | {
        200: {"description": "The whole file.", "content": _FILE},
        206: {"description": "The part that the header `Range` asks for.", "content": _FILE},
    },
)
def download_export(export_id: ExportPath, exports: ExportsDep) -> FileResponse:
    """The file, or the part of it that the header `Range` asks for."""
    path, found = exports.find(export_id)
    return FileResponse(path, media_type=found.media_type, filename=found.file_name)


@router.delete(
    "/exports/{export_id}",
    operation_id="delete-export",
    summary="Delete an export",
    status_code=HTTP_204_NO_CONTENT,
    responses=problems(UnknownExport),
)
def delete_export(export_id: ExportPath, exports: ExportsDep) -> None:
    """Delete the file; the recording and the run stay."""
    exports.delete(export_id)


def _with_run(session: Session, found: ExportFile) -> Export:
    """Return what is known of a file, with the newest run that made one of its id."""
    query = (
        select(RunRow)
        .where(RunRow.kind == "export", RunRow.result_id == found.id)
        .order_by(RunRow.finished_at.desc())
        .limit(1)
    )
    row = session.scalars(query).first()
    return Export(
        **dict(found),
        run=None if row is None else row.id,
        device=None if row is None else row.device_id,
        recording=None if row is None else row.request["recording"],
    )
