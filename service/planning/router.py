"""REST resource /api/v1/device-profiles."""

from fastapi import APIRouter
from starlette.responses import Response

from compute.optics.profiles.loader import profile_names
from compute.planning.result import Plan
from service.errors import Busy, UnknownDeviceProfile
from service.openapi import problems
from service.planning.run import find_profile, picture_of, plan_of, profile_text
from service.planning.schema import (
    DeviceProfileDocument,
    DeviceProfileSummary,
    GridQuery,
    ProfilePath,
    document_of,
    summary_of,
)

router = APIRouter(prefix="/api/v1/device-profiles", tags=["device-profiles"])

_PNG = {"content": {"image/png": {"schema": {"type": "string", "format": "binary"}}}}


@router.get("", operation_id="list-device-profiles", summary="List device profiles")
def list_device_profiles() -> list[DeviceProfileSummary]:
    """The built-in profiles of published devices, by name."""
    return [summary_of(find_profile(name)) for name in profile_names()]


@router.get(
    "/{name}",
    operation_id="get-device-profile",
    summary="Read a device profile",
    responses=problems(UnknownDeviceProfile),
)
def get_device_profile(name: ProfilePath) -> DeviceProfileDocument:
    """One device as published: geometry, detector, markers, rates, volume and figures."""
    return document_of(find_profile(name), profile_text(name))


@router.get(
    "/{name}/plan",
    operation_id="get-plan",
    summary="Plan a device",
    responses=problems(UnknownDeviceProfile, Busy),
)
def get_plan(name: ProfilePath, grid: GridQuery = 3) -> Plan:
    """What the device reaches over its working volume: precision, coverage, rates, ghosts.

    The first answer takes seconds, longer for a finer grid; the same again comes at once.
    """
    return plan_of(name, grid)


@router.get(
    "/{name}/plan.png",
    operation_id="get-plan-picture",
    summary="Draw a plan",
    response_class=Response,
    responses=problems(UnknownDeviceProfile, Busy) | {200: _PNG},
)
def get_plan_picture(name: ProfilePath, grid: GridQuery = 3) -> Response:
    """The plan as a picture (PNG): maps of the deviations, error against distance, ghosts."""
    return Response(picture_of(name, grid), media_type="image/png")
