"""REST resource /api/v1/correction-tables."""

from typing import Annotated, Final

from fastapi import APIRouter, Path, Query, Request
from fastapi.concurrency import run_in_threadpool
from starlette.responses import JSONResponse, Response
from starlette.status import HTTP_201_CREATED, HTTP_204_NO_CONTENT

from compute.errors import InvalidParameter, NonFiniteValue
from service.api.base_models import SLUG_PATTERN, Page
from service.api.correction_tables import store
from service.api.correction_tables.schema import CorrectionTableDocument
from service.api.correction_tables.table_content import MEDIA_TYPE
from service.api.correction_tables.upload_process import read_in_process
from service.api.devices.device_service import DeviceServiceDep
from service.api.inputs import DatabaseDep, DeviceFilter, ExpectedActive, PagingDep, page_of
from service.api.openapi import problems
from service.database.engine import Database
from service.problems.errors import (
    ActivationConflict,
    Busy,
    CorrectionTableExists,
    CorrectionTableInUse,
    InvalidTableFile,
    NoActiveCalibration,
    SensorsChanged,
    TableHasHoles,
    TableOfAnotherCalibration,
    UnknownCorrectionTable,
    UnsupportedMediaType,
)

TABLES_PATH: Final = "/api/v1/correction-tables"

router = APIRouter(prefix=TABLES_PATH, tags=["correction-tables"])

_BINARY: Final = {"schema": {"type": "string", "format": "binary"}}
_TYPES: Final = (MEDIA_TYPE, "application/octet-stream")

TablePath = Annotated[
    str,
    Path(
        pattern=SLUG_PATTERN,
        description="The table's id.",
        openapi_examples={"map": {"summary": "one that was mapped", "value": "sim-map"}},
    ),
]
SparePath = Annotated[
    str,
    Path(
        pattern=SLUG_PATTERN,
        description="The table's id.",
        openapi_examples={"spare": {"summary": "one never used", "value": "sim-map-spare"}},
    ),
]


@router.get("", operation_id="list-correction-tables", summary="List correction tables")
def list_tables(
    database: DatabaseDep,
    paging: PagingDep,
    device: DeviceFilter = None,
    calibration: Annotated[
        str | None, Query(pattern=SLUG_PATTERN, description="Only those of this calibration.")
    ] = None,
) -> Page[CorrectionTableDocument]:
    """Tables without their numbers, newest first."""
    with database.read() as session:
        return page_of(
            session,
            store.tables(device, calibration),
            paging,
            lambda row: store.document(session, row),
        )


@router.post(
    "",
    operation_id="upload-correction-table",
    summary="Upload a correction table",
    status_code=HTTP_201_CREATED,
    response_model=CorrectionTableDocument,
    responses=problems(
        InvalidTableFile,
        InvalidParameter,
        NonFiniteValue,
        TableHasHoles,
        TableOfAnotherCalibration,
        CorrectionTableExists,
        Busy,
    ),
    openapi_extra={"requestBody": {"required": True, "content": {MEDIA_TYPE: _BINARY}}},
)
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
    made = await run_in_threadpool(_stored, database, await request.body(), table_id, note)
    return JSONResponse(
        made.model_dump(mode="json"),
        HTTP_201_CREATED,
        {"Location": f"/api/v1/correction-tables/{made.id}"},
    )


def _stored(
    database: Database, data: bytes, table_id: str | None, note: str
) -> CorrectionTableDocument:
    with database.read() as session:
        store.check_unused(session, table_id)
    content = read_in_process(data)
    with database.write() as session:
        parent = store.find_parent(session, content)
        row = store.add_table(session, content, parent, "upload", note, table_id)
        return store.document(session, row)


@router.get(
    "/{table_id}",
    operation_id="get-correction-table",
    summary="Read a correction table",
    responses=problems(UnknownCorrectionTable),
)
def get_table(table_id: TablePath, database: DatabaseDep) -> CorrectionTableDocument:
    """One table: its grid, provenance and figures."""
    with database.read() as session:
        return store.document(session, store.get_table(session, table_id))


@router.delete(
    "/{table_id}",
    operation_id="delete-correction-table",
    summary="Delete a correction table",
    status_code=HTTP_204_NO_CONTENT,
    responses=problems(UnknownCorrectionTable, CorrectionTableInUse),
)
def delete_table(table_id: SparePath, database: DatabaseDep) -> None:
    """Delete a table that was never active and that no reconstruction names."""
    with database.write() as session:
        store.delete_table(session, table_id)


@router.get(
    "/{table_id}/file",
    operation_id="download-correction-table",
    summary="Download a correction table",
    response_class=Response,
    responses=problems(UnknownCorrectionTable) | {200: {"content": {MEDIA_TYPE: _BINARY}}},
)
def download_table(table_id: TablePath, database: DatabaseDep) -> Response:
    """The whole table as HDF5, with its provenance; it can be uploaded elsewhere."""
    with database.read() as session:
        row = store.get_table(session, table_id)
        data, name = row.data, row.id
    disposition = {"Content-Disposition": f'attachment; filename="{name}.h5"'}
    return Response(data, headers=disposition, media_type=MEDIA_TYPE)


@router.post(
    "/{table_id}/activate",
    operation_id="activate-correction-table",
    summary="Activate a correction table",
    responses=problems(
        UnknownCorrectionTable,
        NoActiveCalibration,
        TableOfAnotherCalibration,
        SensorsChanged,
        ActivationConflict,
    ),
)
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
        device = store.get_table(session, table_id).device_id
    with device_service.pointer_move(
        device, lambda now: now.table_id == table_id, expected
    ) as session:
        return store.document(session, store.activate_table(session, table_id))


@router.post(
    "/{table_id}/deactivate",
    operation_id="deactivate-correction-table",
    summary="Stop using a correction table",
    responses=problems(UnknownCorrectionTable, SensorsChanged, ActivationConflict),
)
def deactivate_table(
    table_id: TablePath, database: DatabaseDep, device_service: DeviceServiceDep
) -> CorrectionTableDocument:
    """Let the device go on without the table; one that is not in use stays as it is."""
    with database.read() as session:
        device = store.get_table(session, table_id).device_id
    with device_service.pointer_move(device, lambda now: now.table_id != table_id) as session:
        return store.document(session, store.deactivate_table(session, table_id))
