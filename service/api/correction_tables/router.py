"""REST resource /api/v1/correction-tables."""

from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import IO, Annotated, Final

from fastapi import Query, Request
from fastapi.concurrency import run_in_threadpool
from starlette.responses import JSONResponse, Response

from service.api.base_models import SLUG_PATTERN
from service.api.correction_tables import store
from service.api.correction_tables.store import CorrectionTableDocument
from service.api.correction_tables.table_content import MEDIA_TYPE
from service.api.correction_tables.upload_process import read_in_process
from service.api.devices.device_service import DeviceServiceDep
from service.api.inputs import (
    DatabaseDep,
    DeviceFilter,
    ExpectedActive,
    id_in_path,
)
from service.api.openapi import ResourceRouter, raises
from service.api.paging import Page, PagingDep, page_of
from service.database.engine import Database
from service.problems.errors import UnsupportedMediaType

TABLES_PATH: Final = "/api/v1/correction-tables"

router = ResourceRouter(TABLES_PATH, "correction-tables")

_BINARY: Final = {"schema": {"type": "string", "format": "binary"}}
_TYPES: Final = (MEDIA_TYPE, "application/octet-stream")
_WRITE_BYTES: Final = 2**20

TablePath = Annotated[str, id_in_path("The table's id.", "sim-map", "map", "one that was mapped")]
SparePath = Annotated[
    str, id_in_path("The table's id.", "sim-map-spare", "spare", "one never used")
]


@router.operation("GET", "list-correction-tables", "List correction tables")
def list_tables(
    database: DatabaseDep,
    paging: PagingDep,
    device_id: DeviceFilter = None,
    calibration_id: Annotated[
        str | None, Query(pattern=SLUG_PATTERN, description="Only those of this calibration.")
    ] = None,
) -> Page[CorrectionTableDocument]:
    """Tables without their numbers, newest first."""
    with database.read() as session:
        return page_of(
            session,
            store.TABLES.newest_first(device_id=device_id, calibration_id=calibration_id),
            paging,
            lambda row: store.document(session, row),
        )


@router.operation(
    "POST",
    "upload-correction-table",
    "Upload a correction table",
    status_code=201,
    response_model=CorrectionTableDocument,
    openapi_extra={"requestBody": {"required": True, "content": {MEDIA_TYPE: _BINARY}}},
)
@raises("invalid-table-file", "invalid-parameter", "non-finite-value", "no-valid-cells")
@raises("foreign-correction-table", "correction-table-exists", "busy")
async def upload_table(
    request: Request,
    database: DatabaseDep,
    table_id: Annotated[
        str | None,
        Query(alias="id", pattern=SLUG_PATTERN, description="Left out: the server's choice."),
    ] = None,
    note: Annotated[
        str, Query(max_length=2000, pattern=r"^[^\u0000]*$", description="For people.")
    ] = "",
) -> Response:
    """Store a table from an HDF5 file, as another server or `lumiline map` made it.

    Its parent calibration must be on this server: it is found by its content hash. The table is
    not activated.
    """
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media_type not in _TYPES:
        given = f'"{media_type}"' if media_type else "not given"
        raise UnsupportedMediaType(f"the body's media type is {given}; send {MEDIA_TYPE}")
    # To a file: a body that is put together and handed on as bytes is copied many times, each time
    # with the interpreter's lock held.
    with NamedTemporaryFile(prefix="lumiline-upload-") as file:
        await _receive(request, file)
        made = await run_in_threadpool(_stored, database, Path(file.name), table_id, note)
    return JSONResponse(made.model_dump(mode="json"), 201, {"Location": f"{TABLES_PATH}/{made.id}"})


async def _receive(request: Request, file: IO[bytes]) -> None:
    """Write a body to a file as it comes."""
    waiting: list[bytes] = []
    size = 0
    async for part in request.stream():
        waiting.append(part)
        size += len(part)
        if size >= _WRITE_BYTES or not part:
            await run_in_threadpool(file.writelines, waiting)
            waiting, size = [], 0
    await run_in_threadpool(file.flush)


def _stored(
    database: Database, path: Path, table_id: str | None, note: str
) -> CorrectionTableDocument:
    with database.read() as session:
        store.TABLES.check_unused(session, table_id)
    content = read_in_process(path)
    with database.write() as session:
        parent = store.find_parent(session, content)
        row = store.add_table(session, content, parent, "upload", note, table_id)
        return store.document(session, row)


@router.operation("GET /{table_id}", "get-correction-table", "Read a correction table")
@raises("unknown-correction-table")
def get_table(table_id: TablePath, database: DatabaseDep) -> CorrectionTableDocument:
    """One table: its grid, provenance and figures."""
    with database.read() as session:
        return store.document(session, store.TABLES.get(session, table_id))


@router.operation("DELETE /{table_id}", "delete-correction-table", "Delete a correction table")
@raises("unknown-correction-table", "correction-table-in-use")
def delete_table(table_id: SparePath, database: DatabaseDep) -> None:
    """Delete a table that was never active and that no reconstruction names."""
    with database.write() as session:
        store.delete_table(session, table_id)


@router.operation(
    "GET /{table_id}/file",
    "download-correction-table",
    "Download a correction table",
    response_class=Response,
    responses={200: {"content": {MEDIA_TYPE: _BINARY}}},
)
@raises("unknown-correction-table")
def download_table(table_id: TablePath, database: DatabaseDep) -> Response:
    """The whole table as HDF5, with its provenance; it can be uploaded elsewhere."""
    with database.read() as session:
        row = store.TABLES.get(session, table_id)
        data, name = row.data, row.id
    disposition = {"Content-Disposition": f'attachment; filename="{name}.h5"'}
    return Response(data, headers=disposition, media_type=MEDIA_TYPE)


@router.operation(
    "POST /{table_id}/activate", "activate-correction-table", "Activate a correction table"
)
@raises("unknown-correction-table", "no-active-calibration", "foreign-correction-table")
@raises("sensors-changed", "activation-conflict", "nominal-calibration-mismatch")
def activate_table(
    table_id: TablePath,
    database: DatabaseDep,
    device_service: DeviceServiceDep,
    expected: ExpectedActive = None,
) -> CorrectionTableDocument:
    """Let the device correct its readings by this table, a running one from the next frame on.

    Its parent must be the active calibration. Activating another calibration ends its use. The
    move is written into the device's history of activations.
    """
    with database.read() as session:
        device = store.TABLES.get(session, table_id).device_id
    with device_service.pointer_move(
        device, lambda now: now.table_id == table_id, expected
    ) as session:
        return store.document(session, store.activate_table(session, table_id))


@router.operation(
    "POST /{table_id}/deactivate", "deactivate-correction-table", "Stop using a correction table"
)
@raises("unknown-correction-table", "sensors-changed", "activation-conflict")
@raises("nominal-calibration-mismatch")
def deactivate_table(
    table_id: TablePath, database: DatabaseDep, device_service: DeviceServiceDep
) -> CorrectionTableDocument:
    """Let the device go on without the table; one that is not in use stays as it is."""
    with database.read() as session:
        device = store.TABLES.get(session, table_id).device_id
    with device_service.pointer_move(device, lambda now: now.table_id != table_id) as session:
        return store.document(session, store.deactivate_table(session, table_id))
