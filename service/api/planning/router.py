"""REST resource /api/v1/device-profiles."""

from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, Final

from fastapi import Body, Depends, Request
from starlette.responses import Response

from compute.planning.plan_result import Plan
from service.api.devices.profiles import (
    all_profiles,
    find_profile,
    profile_text,
    store_posted,
)
from service.api.inputs import DatabaseDep, JsonTypes
from service.api.openapi import ResourceRouter, raises
from service.api.paging import Page, PagingDep, page_of_sequence
from service.api.planning.plan_cache import cached_plan, cached_plot, posted_plan
from service.api.planning.schema import (
    DeviceProfileDocument,
    DeviceProfileSummary,
    GridQuery,
    NewDeviceProfile,
    PlanRequest,
    ProfilePath,
    document_of,
    summary_of,
)
from service.database.audited_session import entry

router = ResourceRouter("/api/v1", "device-profiles")

EXAMPLE: Final = profile_text("bar", Path()).replace('name = "bar"', 'name = "wide-bar"', 1)
"""The built-in bar under a name of its own."""

_NEW_PROFILES: Final[dict[str, Any]] = {
    "wide": {"summary": "The bar under another name", "value": {"toml": EXAMPLE}},
}
_PLANS: Final[dict[str, Any]] = {
    "wide": {"summary": "The bar under another name", "value": {"toml": EXAMPLE, "grid": 3}},
}

NewProfileBody = Annotated[NewDeviceProfile, JsonTypes(), Body(openapi_examples=_NEW_PROFILES)]
PlanBody = Annotated[PlanRequest, JsonTypes(), Body(openapi_examples=_PLANS)]

_PNG = {"content": {"image/png": {"schema": {"type": "string", "format": "binary"}}}}


def _profiles_dir(request: Request) -> Path:
    folder: Path = request.app.state.settings.folders.profiles
    return folder


ProfilesDir = Annotated[Path, Depends(_profiles_dir)]


@router.operation("GET /device-profiles", "list-device-profiles", "List device profiles")
def list_device_profiles(
    profiles_dir: ProfilesDir, paging: PagingDep
) -> Page[DeviceProfileSummary]:
    """The built-in profiles of published devices and those in the data directory, by name."""
    return page_of_sequence(
        all_profiles(profiles_dir), paging, summary_of, lambda profile: (profile.name,)
    )


@router.operation(
    "POST /device-profiles", "create-device-profile", "Keep a device profile", status_code=201
)
@raises("invalid-parameter")
def create_device_profile(
    request: NewProfileBody, profiles_dir: ProfilesDir, database: DatabaseDep, response: Response
) -> DeviceProfileDocument:
    """Keep a profile of your own in the data directory, to be planned and simulated by its name."""
    with database.write() as session:
        profile = store_posted(request.toml, profiles_dir)
        digest = sha256(request.toml.encode()).hexdigest()
        session.add(entry("device-profile", profile.name, "done", after={"sha256": digest}))
    response.headers["Location"] = f"/api/v1/device-profiles/{profile.name}"
    return document_of(profile, request.toml)


@router.operation("POST /profile-plans", "plan-profile", "Plan a device that is not kept")
@raises("invalid-parameter", "busy")
def plan_profile(request: PlanBody) -> Plan:
    """Plan a device of the profile that you send; nothing is stored.

    Takes seconds, longer for a finer grid; the same again comes at once.
    """
    return posted_plan(request.toml, request.grid)


@router.operation(
    "GET /device-profiles/{profile_id}", "get-device-profile", "Read a device profile"
)
@raises("unknown-device-profile", "invalid-parameter")
def get_device_profile(profile_id: ProfilePath, profiles_dir: ProfilesDir) -> DeviceProfileDocument:
    """One device as published: geometry, detector, markers, rates, volume and figures."""
    return document_of(
        find_profile(profile_id, profiles_dir), profile_text(profile_id, profiles_dir)
    )


@router.operation("GET /device-profiles/{profile_id}/plan", "get-plan", "Plan a device")
@raises("unknown-device-profile", "invalid-parameter", "busy")
def get_plan(profile_id: ProfilePath, profiles_dir: ProfilesDir, grid: GridQuery = 3) -> Plan:
    """Expected accuracy, coverage, rates and ghosts over the device's working volume.

    The first answer takes seconds, longer for a finer grid; the same again comes at once.
    """
    return cached_plan(profile_id, profiles_dir, grid)


@router.operation(
    "GET /device-profiles/{profile_id}/plan.png",
    "get-plan-picture",
    "Draw a plan",
    responses={200: _PNG},
    response_class=Response,
)
@raises("unknown-device-profile", "invalid-parameter", "busy")
def get_plan_picture(
    profile_id: ProfilePath, profiles_dir: ProfilesDir, grid: GridQuery = 3
) -> Response:
    """The plan as a picture (PNG): maps of the deviations, error against distance, ghosts."""
    return Response(cached_plot(profile_id, profiles_dir, grid), media_type="image/png")
