"""REST resources of quality checks, drift monitors and assessments."""

from typing import Annotated, Literal

from fastapi import APIRouter, Body, Path, Query
from starlette.responses import Response
from starlette.status import HTTP_201_CREATED, HTTP_204_NO_CONTENT

from compute.errors import InvalidParameter, TooFewPoints
from service.api.base_models import SLUG_PATTERN, Page
from service.api.dependencies import DatabaseDep, LiveDep
from service.api.devices.store import get_device
from service.api.json_body import JsonRoute, JsonTypes
from service.api.openapi import problems
from service.api.pagination import PagingDep, page_of
from service.api.quality import store
from service.api.quality.assessment import quality
from service.api.quality.examples import NEW_CHECKS, WATCHES
from service.api.quality.schema import (
    NewQualityCheck,
    Quality,
    QualityCheck,
    WatchSample,
    WatchSettings,
)
from service.api.request_parameters import DeviceFilter, DevicePath
from service.problems.errors import (
    CalibrationSwitched,
    DeviceNotRunning,
    NoActiveCalibration,
    QualityCheckExists,
    UnknownDevice,
    UnknownQualityCheck,
)

router = APIRouter(prefix="/api/v1", tags=["quality"], route_class=JsonRoute)

NewCheckBody = Annotated[NewQualityCheck, JsonTypes(), Body(openapi_examples=NEW_CHECKS)]
WatchBody = Annotated[WatchSettings, JsonTypes(), Body(openapi_examples=WATCHES)]
CheckPath = Annotated[
    str,
    Path(
        pattern=SLUG_PATTERN,
        description="The check's id.",
        openapi_examples={"bar": {"summary": "of the example body", "value": "sim-bar"}},
    ),
]
_PNG = {"content": {"image/png": {"schema": {"type": "string", "format": "binary"}}}}


@router.post(
    "/devices/{device_id}/quality-checks",
    operation_id="create-quality-check",
    summary="How well does a device measure now?",
    status_code=HTTP_201_CREATED,
    responses=problems(
        UnknownDevice,
        DeviceNotRunning,
        NoActiveCalibration,
        CalibrationSwitched,
        QualityCheckExists,
        TooFewPoints,
        InvalidParameter,
    ),
)
def create_quality_check(
    device_id: DevicePath,
    request: NewCheckBody,
    database: DatabaseDep,
    live: LiveDep,
    response: Response,
) -> QualityCheck:
    """Measure a still marker, or the known distance of two, for some seconds, and keep the result.

    After the single point and point to point tests of ASTM F2554. The answer comes when it is
    measured. Points are made with the active calibration and table.
    """
    from service.api.quality.run_check import measure

    with database.read() as session:
        get_device(session, device_id)
        store.check_unused(session, request.root.id)
    measured = measure(live, device_id, request.root)
    with database.write() as session:
        get_device(session, device_id, lock=True)
        made = store.document(store.add_check(session, device_id, request.root, measured))
    response.headers["Location"] = f"/api/v1/quality-checks/{made.id}"
    return made


@router.get("/quality-checks", operation_id="list-quality-checks", summary="List quality checks")
def list_quality_checks(
    database: DatabaseDep,
    paging: PagingDep,
    device: DeviceFilter = None,
    kind: Annotated[
        Literal["single-point", "point-to-point"] | None, Query(description="Only this kind.")
    ] = None,
) -> Page[QualityCheck]:
    """Checks, newest first."""
    with database.read() as session:
        return page_of(session, store.checks(device, kind), paging, store.document)


@router.get(
    "/quality-checks/{check_id}",
    operation_id="get-quality-check",
    summary="Read a quality check",
    responses=problems(UnknownQualityCheck),
)
def get_quality_check(check_id: CheckPath, database: DatabaseDep) -> QualityCheck:
    """One check."""
    with database.read() as session:
        return store.document(store.get_check(session, check_id))


@router.delete(
    "/quality-checks/{check_id}",
    operation_id="delete-quality-check",
    summary="Delete a quality check",
    status_code=HTTP_204_NO_CONTENT,
    responses=problems(UnknownQualityCheck),
)
def delete_quality_check(check_id: CheckPath, database: DatabaseDep) -> None:
    """For one that was made wrongly: its values take no part in the charts any more."""
    with database.write() as session:
        store.delete_check(session, check_id)


@router.get(
    "/devices/{device_id}/quality",
    operation_id="get-quality",
    summary="Is a device as good as it was?",
    responses=problems(UnknownDevice),
)
def get_quality(device_id: DevicePath, database: DatabaseDep) -> Quality:
    """Control charts of all that was watched and checked with what is active, and what to do."""
    with database.read() as session:
        get_device(session, device_id)
        return quality(session, device_id)


@router.get(
    "/devices/{device_id}/quality.png",
    operation_id="get-quality-picture",
    summary="The control charts of a device",
    response_class=Response,
    responses=problems(UnknownDevice) | {200: _PNG},
)
def get_quality_picture(device_id: DevicePath, database: DatabaseDep) -> Response:
    """The charts of `quality` as PNG."""
    from service.api.quality.control_chart_plot import plot_control_charts

    with database.read() as session:
        get_device(session, device_id)
        found = quality(session, device_id)
    return Response(plot_control_charts(found), media_type="image/png")


@router.get(
    "/devices/{device_id}/watch",
    operation_id="get-watch",
    summary="How a device's drift is watched",
    responses=problems(UnknownDevice),
)
def get_watch(device_id: DevicePath, database: DatabaseDep) -> WatchSettings:
    """The settings; the defaults while nobody has changed them."""
    with database.read() as session:
        get_device(session, device_id)
        return store.watch_of(session, device_id)


@router.put(
    "/devices/{device_id}/watch",
    operation_id="set-watch",
    summary="Say how a device's drift is watched",
    responses=problems(UnknownDevice),
)
def set_watch(device_id: DevicePath, request: WatchBody, database: DatabaseDep) -> WatchSettings:
    """Takes effect within seconds; what was watched before stays in the charts."""
    with database.write() as session:
        get_device(session, device_id, lock=True)
        store.set_watch(session, device_id, request)
    return request


@router.get("/watch-samples", operation_id="list-watch-samples", summary="List what the watch saw")
def list_watch_samples(
    database: DatabaseDep, paging: PagingDep, device: DeviceFilter = None
) -> Page[WatchSample]:
    """One for each interval of a running device, newest first."""
    with database.read() as session:
        return page_of(session, store.samples(device), paging, store.sample)
