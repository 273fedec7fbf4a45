"""REST resource /api/v1/beam-holds."""

import time
from typing import Annotated

from fastapi import Body, Path, Response

from compute.pose.beam_hold import BeamHoldCause
from service.api.base_models import SLUG_PATTERN
from service.api.beam_holds import store
from service.api.beam_holds.examples import BEAM_HOLD_IDS, CHANGES, NEW_BEAM_HOLDS, REFERENCES
from service.api.beam_holds.monitor_config import to_spec, to_watch
from service.api.beam_holds.schema import (
    BeamHold,
    BeamHoldChange,
    BeamHoldStatus,
    NewBeamHold,
    NewReference,
)
from service.api.devices.device_service import DeviceServiceDep
from service.api.inputs import (
    DatabaseDep,
    DeviceFilter,
    JsonTypes,
    LiveDep,
)
from service.api.openapi import ResourceRouter, raises
from service.api.paging import BY_ID, Page, PagingDep, page_of
from service.api.preconditions import OptionalIfMatch, RequiredIfMatch
from service.api.tools import concurrency_limits
from service.database.models import HoldRow
from service.pipeline.frame_batch import BeamHoldState
from service.pipeline.interface import Pipeline

router = ResourceRouter("/api/v1", "beam-holds")

NewBeamHoldBody = Annotated[NewBeamHold, JsonTypes(), Body(openapi_examples=NEW_BEAM_HOLDS)]
ChangeBody = Annotated[BeamHoldChange, JsonTypes(), Body(openapi_examples=CHANGES)]
ReferenceBody = Annotated[NewReference, JsonTypes(), Body(openapi_examples=REFERENCES)]
BeamHoldPath = Annotated[
    str, Path(pattern=SLUG_PATTERN, description="The hold's id.", openapi_examples=BEAM_HOLD_IDS)
]


@router.operation("GET /beam-holds", "list-beam-holds", "List beam holds")
def list_beam_holds(
    database: DatabaseDep, paging: PagingDep, device_id: DeviceFilter = None
) -> Page[BeamHold]:
    """Holds by id."""
    with database.read() as session:
        return page_of(session, store.holds(device_id), paging, store.document, BY_ID)


@router.operation("POST /beam-holds", "create-beam-hold", "Create a beam hold", status_code=201)
@raises("device-elsewhere")
@raises("unknown-device", "unknown-tool", "beam-hold-exists", "too-many-beam-holds")
@raises("invalid-parameter")
def create_beam_hold(
    request: NewBeamHoldBody, live: LiveDep, device_service: DeviceServiceDep, response: Response
) -> BeamHold:
    """Create a beam hold: its target, and how far that may move.

    The beam is held from the first: until there is a reference, and all was near it for as long
    as `settle_s`.
    """
    with device_service.tools_change(request.device_id) as session:
        made = _set_up(live, store.add_beam_hold(session, request))
    response.headers["Location"] = f"/api/v1/beam-holds/{made.id}"
    return made


@router.operation("GET /beam-holds/{hold_id}", "get-beam-hold", "Read a beam hold")
@raises("unknown-beam-hold")
def get_beam_hold(hold_id: BeamHoldPath, database: DatabaseDep) -> BeamHold:
    """One hold."""
    with database.read() as session:
        return store.document(store.BEAM_HOLDS.get(session, hold_id))


@router.operation(
    "PATCH /beam-holds/{hold_id}", "change-beam-hold", "Change a beam hold's limits, rules or title"
)
@raises("unknown-beam-hold", "invalid-parameter")
@raises("precondition-failed", "precondition-required", "invalid-precondition")
def change_beam_hold(
    hold_id: BeamHoldPath,
    request: ChangeBody,
    database: DatabaseDep,
    device_service: DeviceServiceDep,
    expected: RequiredIfMatch,
) -> BeamHold:
    """Change some members; other limits or rules hold the beam, and it settles anew.

    What is watched never changes: delete the hold and create another.
    """
    with device_service.tools_change(_device_of(database, hold_id)) as session:
        row = store.BEAM_HOLDS.get(session, hold_id)
        expected.check(store.document(row))
        return store.document(store.change_beam_hold(session, row, request))


@router.operation("DELETE /beam-holds/{hold_id}", "delete-beam-hold", "Delete a beam hold")
@raises("unknown-beam-hold", "precondition-failed", "invalid-precondition")
def delete_beam_hold(
    hold_id: BeamHoldPath,
    database: DatabaseDep,
    device_service: DeviceServiceDep,
    expected: OptionalIfMatch,
) -> None:
    """Delete a hold; the last that clients of the stream hear of it is that it is held."""
    with device_service.tools_change(_device_of(database, hold_id)) as session:
        row = store.BEAM_HOLDS.get(session, hold_id)
        expected.check(store.document(row))
        session.delete(row)


@router.operation(
    "POST /beam-holds/{hold_id}/reference",
    "set-beam-hold-reference",
    "Say that all is where it is to be",
)
@raises("unknown-beam-hold", "beam-hold-replaced", "busy", "device-not-running")
@raises("no-active-calibration", "calibration-switched", "nothing-seen", "not-stationary")
@raises("invalid-parameter")
def set_beam_hold_reference(
    hold_id: BeamHoldPath,
    request: ReferenceBody,
    database: DatabaseDep,
    live: LiveDep,
    device_service: DeviceServiceDep,
) -> BeamHold:
    """Measure the set-up, with the patient at rest, or store a given reference.

    It belongs to the active calibration and table: while others are active, the beam is held. A
    latch of the reference before ends with it.
    """
    from service.api.beam_holds.reference_capture import capture_reference

    with database.read() as session:
        row = store.BEAM_HOLDS.get(session, hold_id)
        device, created, spec = row.device_id, row.created_at, to_spec(to_watch(row))
        before = store.reference_id(row)
    if request.given is not None:
        with device_service.tools_change(device) as session:
            row = store.get_same_beam_hold(session, hold_id, created, before)
            return _set_up(live, store.set_given(session, row, request.given))
    with concurrency_limits.captures:
        measured, calibration, table = capture_reference(live, device, spec, request)
    with device_service.tools_change(device) as session:
        row = store.get_same_beam_hold(session, hold_id, created, before)
        reference = store.complete_reference(measured, calibration, table)
        return _set_up(live, store.set_reference(session, row, reference))


@router.operation(
    "DELETE /beam-holds/{hold_id}/reference",
    "remove-beam-hold-reference",
    "Take a beam hold's reference away",
)
@raises("unknown-beam-hold")
def delete_beam_hold_reference(
    hold_id: BeamHoldPath, database: DatabaseDep, device_service: DeviceServiceDep
) -> BeamHold:
    """The beam is held until there is another: between two patients."""
    with device_service.tools_change(_device_of(database, hold_id)) as session:
        row = store.BEAM_HOLDS.get(session, hold_id)
        return store.document(store.set_reference(session, row, None))


@router.operation(
    "POST /beam-holds/{hold_id}/acknowledge", "acknowledge-beam-hold", "Acknowledge a latched hold"
)
@raises("device-elsewhere")
@raises("unknown-beam-hold")
def acknowledge_beam_hold(
    hold_id: BeamHoldPath, database: DatabaseDep, live: LiveDep, response: Response
) -> BeamHoldStatus:
    """Let a latched hold end, with the next frames and once all is back; nothing else changes."""
    device = _device_of(database, hold_id)
    live.holds.acknowledge(hold_id)
    response.headers["Cache-Control"] = "no-store"
    return state_of(live, device, hold_id)


@router.operation(
    "GET /beam-holds/{hold_id}/state", "get-beam-hold-state", "Whether the beam is held now"
)
@raises("device-elsewhere")
@raises("unknown-beam-hold")
def get_beam_hold_state(
    hold_id: BeamHoldPath, database: DatabaseDep, live: LiveDep, response: Response
) -> BeamHoldStatus:
    """Whether the beam is held now, and why; never to be kept by a cache.

    To act on it use the stream with content `holds`, which tells of changes at once.
    """
    device = _device_of(database, hold_id)
    response.headers["Cache-Control"] = "no-store"
    return state_of(live, device, hold_id)


def _set_up(live: Pipeline, row: HoldRow) -> BeamHold:
    """Return a hold with its reference, captured now where it has none."""
    made = store.document(row)
    if made.reference is not None:
        live.holds.set_up(made.reference.id)
    return made


def _device_of(database: DatabaseDep, hold_id: str) -> str:
    with database.read() as session:
        return store.BEAM_HOLDS.get(session, hold_id).device_id


def state_of(live: Pipeline, device_id: str, hold_id: str) -> BeamHoldStatus:
    """Return the state of a beam hold; one that is not monitored holds the beam."""
    now = live.holds.now(hold_id)
    if now is None:
        # Of a server that is starting, or one that could not take the hold over.
        why = "it is not watched"
        now = BeamHoldState(hold_id, True, BeamHoldCause.NO_DATA, why, time.time_ns())
    members = {
        name: getattr(now, name) for name in BeamHoldStatus.model_fields if hasattr(now, name)
    }
    return BeamHoldStatus(**members | {"device_id": device_id})
