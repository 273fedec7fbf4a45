"""REST resource /api/v1/holds."""

from typing import Annotated

from fastapi import APIRouter, Body, Path, Response
from starlette.status import HTTP_201_CREATED, HTTP_204_NO_CONTENT

from compute.errors import InvalidParameter, NotStill
from service.database.models import HoldRow
from service.dependencies import DatabaseDep, LiveDep, OperationDep
from service.errors import (
    Busy,
    CalibrationSwitched,
    DeviceNotRunning,
    HoldExists,
    HoldReplaced,
    NoActiveCalibration,
    NothingSeen,
    TooManyHolds,
    UnknownDevice,
    UnknownHold,
    UnknownTool,
)
from service.holds import store
from service.holds.examples import CHANGES, HOLD_IDS, NEW_HOLDS, REFERENCES
from service.holds.schema import Hold, HoldChange, HoldState, NewHold, NewReference
from service.holds.specs import spec_of, watch_of
from service.holds.state import state_of
from service.json_body import FromJson, JsonRoute
from service.live.manager import LiveManager
from service.openapi import problems
from service.pages import PagingDep, page_of
from service.parameters import DeviceFilter
from service.schema import SLUG_PATTERN, Page
from service.tools.waiting import waiting

router = APIRouter(prefix="/api/v1", tags=["holds"], route_class=JsonRoute)

NewHoldBody = Annotated[NewHold, FromJson(), Body(openapi_examples=NEW_HOLDS)]
ChangeBody = Annotated[HoldChange, FromJson(), Body(openapi_examples=CHANGES)]
ReferenceBody = Annotated[NewReference, FromJson(), Body(openapi_examples=REFERENCES)]
HoldPath = Annotated[
    str, Path(pattern=SLUG_PATTERN, description="The hold's id.", openapi_examples=HOLD_IDS)
]


@router.get("/holds", operation_id="list-holds", summary="List beam holds")
def list_holds(database: DatabaseDep, paging: PagingDep, device: DeviceFilter = None) -> Page[Hold]:
    """Holds by id."""
    with database.read() as session:
        return page_of(session, store.holds(device), paging, store.document)


@router.post(
    "/holds",
    operation_id="create-hold",
    summary="Create a beam hold",
    status_code=HTTP_201_CREATED,
    responses=problems(UnknownDevice, UnknownTool, HoldExists, TooManyHolds, InvalidParameter),
)
def create_hold(
    request: NewHoldBody, live: LiveDep, operation: OperationDep, response: Response
) -> Hold:
    """Say what is watched, and how far it may move.

    The beam is held from the first: until there is a reference, and all was near it for as long
    as `settle_s`.
    """
    with operation.tools_change(request.device) as session:
        made = _set_up(live, store.add_hold(session, request))
    response.headers["Location"] = f"/api/v1/holds/{made.id}"
    return made


@router.get(
    "/holds/{hold_id}",
    operation_id="get-hold",
    summary="Read a beam hold",
    responses=problems(UnknownHold),
)
def get_hold(hold_id: HoldPath, database: DatabaseDep) -> Hold:
    """One hold."""
    with database.read() as session:
        return store.document(store.get_hold(session, hold_id))


@router.patch(
    "/holds/{hold_id}",
    operation_id="change-hold",
    summary="Change a beam hold's limits, rules or title",
    responses=problems(UnknownHold, InvalidParameter),
)
def change_hold(
    hold_id: HoldPath, request: ChangeBody, database: DatabaseDep, operation: OperationDep
) -> Hold:
    """Change what is given; other limits or rules hold the beam, and it settles anew.

    What is watched never changes: delete the hold and create another.
    """
    with operation.tools_change(_device_of(database, hold_id)) as session:
        return store.document(store.change_hold(session, store.get_hold(session, hold_id), request))


@router.delete(
    "/holds/{hold_id}",
    operation_id="delete-hold",
    summary="Delete a beam hold",
    status_code=HTTP_204_NO_CONTENT,
    responses=problems(UnknownHold),
)
def delete_hold(hold_id: HoldPath, database: DatabaseDep, operation: OperationDep) -> None:
    """Delete a hold; the last that clients of the stream hear of it is that it is held."""
    with operation.tools_change(_device_of(database, hold_id)) as session:
        session.delete(store.get_hold(session, hold_id))


@router.post(
    "/holds/{hold_id}/reference",
    operation_id="set-hold-reference",
    summary="Say that all is where it is to be",
    responses=problems(
        UnknownHold,
        HoldReplaced,
        Busy,
        DeviceNotRunning,
        NoActiveCalibration,
        CalibrationSwitched,
        NothingSeen,
        NotStill,
        InvalidParameter,
    ),
)
def set_hold_reference(
    hold_id: HoldPath,
    request: ReferenceBody,
    database: DatabaseDep,
    live: LiveDep,
    operation: OperationDep,
) -> Hold:
    """Measure the set-up, with the patient at rest, or take what is given.

    It belongs to the calibration and table in force: with others in force the beam is held. A
    latch of the reference before ends with it.
    """
    from service.holds.capture import captured

    with database.read() as session:
        row = store.get_hold(session, hold_id)
        device, created, spec = row.device_id, row.created_at, spec_of(watch_of(row))
        before = store.reference_id(row)
    if request.given is not None:
        with operation.tools_change(device) as session:
            row = store.get_same_hold(session, hold_id, created, before)
            return _set_up(live, store.set_given(session, row, request.given))
    with waiting():
        measured, calibration, table = captured(live, device, spec, request)
    with operation.tools_change(device) as session:
        row = store.get_same_hold(session, hold_id, created, before)
        return _set_up(live, store.set_captured(session, row, measured, calibration, table))


@router.delete(
    "/holds/{hold_id}/reference",
    operation_id="remove-hold-reference",
    summary="Take a beam hold's reference away",
    responses=problems(UnknownHold),
)
def delete_hold_reference(
    hold_id: HoldPath, database: DatabaseDep, operation: OperationDep
) -> Hold:
    """The beam is held until there is another: between two patients."""
    with operation.tools_change(_device_of(database, hold_id)) as session:
        return store.document(store.remove_reference(session, store.get_hold(session, hold_id)))


@router.post(
    "/holds/{hold_id}/acknowledge",
    operation_id="acknowledge-hold",
    summary="Acknowledge a latched hold",
    responses=problems(UnknownHold),
)
def acknowledge_hold(
    hold_id: HoldPath, database: DatabaseDep, live: LiveDep, response: Response
) -> HoldState:
    """Let a latched hold end, with the next frames and once all is back; nothing else changes."""
    device = _device_of(database, hold_id)
    live.holds.acknowledge(hold_id)
    response.headers["Cache-Control"] = "no-store"
    return state_of(live, device, hold_id)


@router.get(
    "/holds/{hold_id}/state",
    operation_id="get-hold-state",
    summary="Whether the beam is held now",
    responses=problems(UnknownHold),
)
def get_hold_state(
    hold_id: HoldPath, database: DatabaseDep, live: LiveDep, response: Response
) -> HoldState:
    """Whether the beam is held now, and why; never to be kept by a cache.

    To act on it use the stream with content `holds`, which tells of changes at once.
    """
    device = _device_of(database, hold_id)
    response.headers["Cache-Control"] = "no-store"
    return state_of(live, device, hold_id)


def _set_up(live: LiveManager, row: HoldRow) -> Hold:
    """Return a hold whose reference, if it has one, is taken now; said before it is watched."""
    made = store.document(row)
    if made.reference is not None:
        live.holds.set_up(made.reference.id)
    return made


def _device_of(database: DatabaseDep, hold_id: str) -> str:
    with database.read() as session:
        return store.get_hold(session, hold_id).device_id
