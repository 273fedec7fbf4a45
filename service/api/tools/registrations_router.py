"""REST resource /api/v1/registrations."""

from dataclasses import replace
from typing import Annotated

from fastapi import Body, Response

from service.api.devices.store import get_device
from service.api.inputs import (
    DatabaseDep,
    DeviceFilter,
    JsonTypes,
    LiveDep,
    SettingsDep,
    id_in_path,
)
from service.api.openapi import ResourceRouter, raises
from service.api.paging import Page, PagingDep, page_of
from service.api.tools import concurrency_limits
from service.api.tools import registrations as store
from service.api.tools.dependency_check import dependencies
from service.api.tools.examples import NEW_REGISTRATIONS
from service.api.tools.provenance import active_ids
from service.api.tools.registration_schema import (
    NewPairedPoints,
    NewRegistration,
    NewSurface,
    NewThreeMarkers,
    Registration,
)
from service.database.engine import Database
from service.pipeline.interface import Pipeline
from service.settings import Settings

router = ResourceRouter("/api/v1/registrations", "tools")

NewRegistrationBody = Annotated[
    NewRegistration, JsonTypes(), Body(openapi_examples=NEW_REGISTRATIONS)
]
RegistrationPath = Annotated[
    str, id_in_path("The registration's id, the name of its frame.", "image", "image")
]


@router.operation("GET", "list-registrations", "List registrations")
def list_registrations(
    database: DatabaseDep, paging: PagingDep, device_id: DeviceFilter = None
) -> Page[Registration]:
    """Registrations, newest first."""
    with database.read() as session:
        return page_of(
            session, store.REGISTRATIONS.newest_first(device_id=device_id), paging, store.document
        )


@router.operation(
    "POST",
    "create-registration",
    "Register paired points, three markers, or a surface: a named frame",
    status_code=201,
)
@raises("unknown-device", "unknown-tool", "unknown-registration", "registration-exists")
@raises("registration-replaced", "tool-replaced", "busy", "device-not-running")
@raises("no-active-calibration", "calibration-switched", "nothing-seen", "not-stationary")
@raises("too-few-poses", "too-few-points", "collinear-points", "duplicate-point")
@raises("undetermined-parameters", "high-error", "no-convergence", "invalid-parameter")
def create_registration(
    request: NewRegistrationBody,
    database: DatabaseDep,
    live: LiveDep,
    settings: SettingsDep,
    response: Response,
) -> Registration:
    """Find where a frame lies. Its `kind` says from what.

    `paired-points`, also where none is given: points known in the frame, such as an image's, and
    measured. Tells how well the fiducials fit (FRE).

    `three-markers`: three markers make the frame, where they are given or a running device strobes
    them. Hold them still until this answers.

    `surface`: points measured on a surface that is known in the frame refine the registration
    `parent_id`. Tells how far off it they are, and which motion it holds least.

    All tell what to expect at targets (TRE). Poses can be asked for in the frame from then on:
    `GET /api/v1/tools/{id}/pose?frame_id=ID`.
    """
    asked = request.root
    if isinstance(asked, NewPairedPoints):
        made = _of_pairs(asked)
    elif isinstance(asked, NewThreeMarkers):
        made = _of_markers(database, live, asked)
    else:
        made = _of_surface(database, settings, asked)
    with database.write() as session:
        get_device(session, asked.device_id, lock=True)
        found = store.document(store.add_registration(session, asked, made))
    response.headers["Location"] = f"/api/v1/registrations/{found.id}"
    return found


def _of_pairs(asked: NewPairedPoints) -> store.NewRegistrationRecord:
    from service.api.tools.registration_pairs import paired

    kept = asked.model_dump(mode="json", exclude={"note"})
    return store.NewRegistrationRecord(paired(asked), kept, asked.reference_id)


def _of_markers(
    database: Database, live: Pipeline, asked: NewThreeMarkers
) -> store.NewRegistrationRecord:
    from service.api.tools.registration_markers import of_markers

    with database.read() as session:
        get_device(session, asked.device_id)
        store.check_new(session, asked, asked.reference_id)
        relied = dependencies(session, [asked.reference_id])
    if asked.strobe_markers is None:
        return replace(of_markers(live, asked), dependencies=relied)
    with concurrency_limits.captures:
        return replace(of_markers(live, asked), dependencies=relied)


def _of_surface(
    database: Database, settings: Settings, asked: NewSurface
) -> store.NewRegistrationRecord:
    from service.api.tools.registration_surface import check_size, refine_by_surface, stored_request

    check_size(asked, settings)
    with database.read() as session:
        get_device(session, asked.device_id)
        parent = store.REGISTRATIONS.get(session, asked.parent_id)
        store.check_parent(session, asked, parent)
        start = store.frame_from_measured(parent)
        active = active_ids(session, asked.device_id)
        reference, created = parent.reference_id, parent.created_at
        relied = dependencies(session, [reference], [parent])
    with concurrency_limits.surfaces:
        result = refine_by_surface(asked, start)
    of = {"parent_id": asked.parent_id, "parent_created_at": created.isoformat()}
    with_these = (active["calibration_id"], active["table_id"])
    return store.NewRegistrationRecord(
        result | of, stored_request(asked), reference, with_these, relied
    )


@router.operation("GET /{registration_id}", "get-registration", "Read a registration")
@raises("unknown-registration")
def get_registration(registration_id: RegistrationPath, database: DatabaseDep) -> Registration:
    """One registration."""
    with database.read() as session:
        return store.document(store.REGISTRATIONS.get(session, registration_id))


@router.operation("DELETE /{registration_id}", "delete-registration", "Delete a registration")
@raises("unknown-registration")
def delete_registration(registration_id: RegistrationPath, database: DatabaseDep) -> None:
    """Delete a registration: no pose can be asked for in its frame any more."""
    with database.write() as session:
        session.delete(store.REGISTRATIONS.get(session, registration_id))
