"""REST resource /api/v1/device-profiles."""

from pathlib import Path
from typing import Annotated

from fastapi import Depends, Request
from starlette.responses import Response

from compute.planning.plan_result import Plan
from service.api.devices.profiles import all_profiles, find_profile, profile_text
from service.api.openapi import ResourceRouter, raises
from service.api.paging import Page, PagingDep, page_of_sequence
from service.api.planning.plan_cache import cached_plan, cached_plot
from service.api.planning.schema import (
    DeviceProfileDocument,
    DeviceProfileSummary,
    GridQuery,
    ProfilePath,
    document_of,
    summary_of,
)

router = ResourceRouter("/api/v1/device-profiles", "device-profiles")

_PNG = {"content": {"image/png": {"schema": {"type": "string", "format": "binary"}}}}


def _profiles_dir(request: Request) -> Path:
    folder: Path = request.app.state.settings.folders.profiles
    return folder


ProfilesDir = Annotated[Path, Depends(_profiles_dir)]


@router.operation("GET", "list-device-profiles", "List device profiles")
def list_device_profiles(
    profiles_dir: ProfilesDir, paging: PagingDep
) -> Page[DeviceProfileSummary]:
    """The built-in profiles of published devices and those in the data directory, by name."""
    return page_of_sequence(
        all_profiles(profiles_dir), paging, summary_of, lambda profile: (profile.name,)
    )


@router.operation("GET /{profile_id}", "get-device-profile", "Read a device profile")
@raises("unknown-device-profile", "invalid-parameter")
def get_device_profile(profile_id: ProfilePath, profiles_dir: ProfilesDir) -> DeviceProfileDocument:
    """One device as published: geometry, detector, markers, rates, volume and figures."""
    return document_of(
        find_profile(profile_id, profiles_dir), profile_text(profile_id, profiles_dir)
    )


@router.operation("GET /{profile_id}/plan", "get-plan", "Plan a device")
@raises("unknown-device-profile", "invalid-parameter", "busy")
def get_plan(profile_id: ProfilePath, profiles_dir: ProfilesDir, grid: GridQuery = 3) -> Plan:
    """What the device reaches over its working volume: accuracy, coverage, rates, ghosts.

    The first answer takes seconds, longer for a finer grid; the same again comes at once.
    """
    return cached_plan(profile_id, profiles_dir, grid)


@router.operation(
    "GET /{profile_id}/plan.png",
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
