"""REST resource /api/v1/registrations."""

from typing import Annotated

from fastapi import APIRouter, Body, Path, Response
from starlette.status import HTTP_201_CREATED, HTTP_204_NO_CONTENT

from compute.errors import (
    CollinearPoints,
    DuplicatePoint,
    InvalidParameter,
    NoConvergence,
)
from service.dependencies import DatabaseDep
from service.devices.store import get_device
from service.errors import (
    RegistrationExists,
    UnknownDevice,
    UnknownRegistration,
    UnknownTool,
)
from service.json_body import FromJson, JsonRoute
from service.openapi import problems
from service.pages import PagingDep, page_of
from service.parameters import DeviceFilter
from service.schema import SLUG_PATTERN, Page
from service.tools import registrations as store
from service.tools.examples import NEW_REGISTRATIONS, REGISTRATION_IDS
from service.tools.registration_schema import NewRegistration, Registration

router = APIRouter(prefix="/api/v1/registrations", tags=["tools"], route_class=JsonRoute)

NewRegistrationBody = Annotated[
    NewRegistration, FromJson(), Body(openapi_examples=NEW_REGISTRATIONS)
]
RegistrationPath = Annotated[
    str,
    Path(
        pattern=SLUG_PATTERN,
        description="The registration's id, the name of its frame.",
        openapi_examples=REGISTRATION_IDS,
    ),
]


@router.get("", operation_id="list-registrations", summary="List registrations")
def list_registrations(
    database: DatabaseDep, paging: PagingDep, device: DeviceFilter = None
) -> Page[Registration]:
    """Registrations, newest first."""
    with database.read() as session:
        return page_of(session, store.registrations(device), paging, store.document)


@router.post(
    "",
    operation_id="create-registration",
    summary="Register paired points: a named frame",
    status_code=HTTP_201_CREATED,
    responses=problems(
        UnknownDevice,
        UnknownTool,
        RegistrationExists,
        CollinearPoints,
        DuplicatePoint,
        NoConvergence,
        InvalidParameter,
    ),
)
def create_registration(
    request: NewRegistrationBody, database: DatabaseDep, response: Response
) -> Registration:
    """Find where a frame lies from points known in it and measured, such as an image's.

    Tells how well the fiducials fit (FRE) and what to expect at targets (TRE). Poses can be asked
    for in the frame from then on: `GET /api/v1/tools/{id}/pose?frame=ID`.
    """
    result = store.registered(request)
    with database.write() as session:
        get_device(session, request.device, lock=True)
        made = store.document(store.add_registration(session, request, result))
    response.headers["Location"] = f"/api/v1/registrations/{made.id}"
    return made


@router.get(
    "/{registration_id}",
    operation_id="get-registration",
    summary="Read a registration",
    responses=problems(UnknownRegistration),
)
def get_registration(registration_id: RegistrationPath, database: DatabaseDep) -> Registration:
    """One registration."""
    with database.read() as session:
        return store.document(store.get_registration(session, registration_id))


@router.delete(
    "/{registration_id}",
    operation_id="delete-registration",
    summary="Delete a registration",
    status_code=HTTP_204_NO_CONTENT,
    responses=problems(UnknownRegistration),
)
def delete_registration(registration_id: RegistrationPath, database: DatabaseDep) -> None:
    """Delete a registration: no pose can be asked for in its frame any more."""
    with database.write() as session:
        session.delete(store.get_registration(session, registration_id))
