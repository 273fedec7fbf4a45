"""REST resource /api/v1/exports."""

from typing import Annotated

from fastapi import Depends, Path, Request
from sqlalchemy import select
from sqlalchemy.orm import Session
from starlette.responses import FileResponse

from service.api.base_models import SLUG_PATTERN
from service.api.exports.examples import EXPORT_IDS
from service.api.exports.repository import MEDIA_TYPES, ExportRepository
from service.api.exports.schema import Export, ExportFile
from service.api.inputs import DatabaseDep
from service.api.openapi import ResourceRouter, raises
from service.api.paging import Page, PagingDep, page_of_sequence
from service.database.models import RunRow

router = ResourceRouter("/api/v1", "recordings")

_BINARY = {"schema": {"type": "string", "format": "binary"}}
_FILE = dict.fromkeys(dict.fromkeys(MEDIA_TYPES.values()), _BINARY)


def _exports(request: Request) -> ExportRepository:
    exports: ExportRepository = request.app.state.exports
    return exports


ExportsDep = Annotated[ExportRepository, Depends(_exports)]
ExportPath = Annotated[
    str,
    Path(pattern=SLUG_PATTERN, description="The export's id.", openapi_examples=EXPORT_IDS),
]


@router.operation("GET /exports", "list-exports", "List exports")
def list_exports(exports: ExportsDep, database: DatabaseDep, paging: PagingDep) -> Page[Export]:
    """Files that export runs have made and nobody has deleted, the newest first."""
    with database.read() as session:
        return page_of_sequence(
            exports.all(),
            paging,
            lambda found: _with_run(session, found),
            lambda found: (-round(found.created_at.timestamp() * 1e6), found.id),
        )


@router.operation("GET /exports/{export_id}", "get-export", "Read about an export")
@raises("unknown-export")
def get_export(export_id: ExportPath, exports: ExportsDep, database: DatabaseDep) -> Export:
    """Source, format and size of an export."""
    found = exports.document(export_id)
    with database.read() as session:
        return _with_run(session, found)


@router.operation(
    "GET /exports/{export_id}/file",
    "download-export",
    "Download an export",
    responses={
        200: {"description": "The whole file.", "content": _FILE},
        206: {"description": "The part that the header `Range` asks for.", "content": _FILE},
    },
    response_class=FileResponse,
)
@raises("unknown-export", "file-elsewhere")
def download_export(export_id: ExportPath, exports: ExportsDep) -> FileResponse:
    """The file, or the part of it that the header `Range` asks for."""
    path, found = exports.find(export_id)
    return FileResponse(path, media_type=found.media_type, filename=found.file_name)


@router.operation("DELETE /exports/{export_id}", "delete-export", "Delete an export")
@raises("unknown-export", "file-elsewhere")
def delete_export(export_id: ExportPath, exports: ExportsDep) -> None:
    """Delete the file; the recording and the run stay."""
    exports.delete(export_id)


def _with_run(session: Session, found: ExportFile) -> Export:
    """Return an export's document with the newest run that made a file of its id."""
    query = (
        select(RunRow)
        .where(RunRow.kind == "export", RunRow.result_id == found.id)
        .order_by(RunRow.finished_at.desc())
        .limit(1)
    )
    row = session.scalars(query).first()
    return Export(
        **dict(found),
        run_id=None if row is None else row.id,
        device_id=None if row is None else row.device_id,
        recording_id=None if row is None else row.request["recording_id"],
    )
