"""REST resources of quality checks, drift monitors and assessments."""

from typing import Annotated, Any, Final, Literal

from fastapi import Body, Query
from starlette.responses import Response

from service.api.devices.store import get_device
from service.api.inputs import (
    DatabaseDep,
    DeviceFilter,
    DevicePath,
    JsonTypes,
    LiveDep,
    id_in_path,
)
from service.api.openapi import ResourceRouter, raises
from service.api.paging import LATEST_FIRST, Page, PagingDep, page_of
from service.api.preconditions import RequiredIfMatch
from service.api.quality import store
from service.api.quality.assessment import quality
from service.api.quality.schema import (
    NewQualityCheck,
    Quality,
    QualityCheck,
    WatchSample,
    WatchSettings,
)

router = ResourceRouter("/api/v1", "quality")

_NEW_CHECKS: Final[dict[str, Any]] = {
    "bar": {
        "summary": "The simulated bar's two markers, which turn on a circle of 146 mm radius",
        "value": {
            "id": "sim-bar",
            "kind": "point-to-point",
            "markers": [0, 1],
            "reference_mm": 292.0,
            "reference_sigma_mm": 0.05,
            "duration_s": 2.0,
            "tolerance_mm": 1.0,
        },
    },
}

_WATCHES: Final[dict[str, Any]] = {
    "ten-minutes": {"summary": "A value each ten minutes", "value": {"interval_s": 600.0}},
}

NewCheckBody = Annotated[NewQualityCheck, JsonTypes(), Body(openapi_examples=_NEW_CHECKS)]
WatchBody = Annotated[WatchSettings, JsonTypes(), Body(openapi_examples=_WATCHES)]
CheckPath = Annotated[str, id_in_path("The check's id.", "sim-bar", "bar")]
_PNG = {"content": {"image/png": {"schema": {"type": "string", "format": "binary"}}}}


@router.operation(
    "POST /devices/{device_id}/quality-checks",
    "create-quality-check",
    "How well does a device measure now?",
    status_code=201,
)
@raises("unknown-device", "device-not-running", "no-active-calibration", "calibration-switched")
@raises("quality-check-exists", "too-few-points", "invalid-parameter")
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
        store.QUALITY_CHECKS.check_unused(session, request.root.id)
    measured = measure(live, device_id, request.root)
    with database.write() as session:
        get_device(session, device_id, lock=True)
        made = store.document(store.add_check(session, device_id, request.root, measured))
    response.headers["Location"] = f"/api/v1/quality-checks/{made.id}"
    return made


@router.operation("GET /quality-checks", "list-quality-checks", "List quality checks")
def list_quality_checks(
    database: DatabaseDep,
    paging: PagingDep,
    device_id: DeviceFilter = None,
    kind: Annotated[
        Literal["single-point", "point-to-point"] | None, Query(description="Only this kind.")
    ] = None,
) -> Page[QualityCheck]:
    """Checks, newest first."""
    with database.read() as session:
        return page_of(
            session,
            store.QUALITY_CHECKS.newest_first(device_id=device_id, kind=kind),
            paging,
            store.document,
        )


@router.operation(
    "GET /quality-checks/{quality_check_id}", "get-quality-check", "Read a quality check"
)
@raises("unknown-quality-check")
def get_quality_check(quality_check_id: CheckPath, database: DatabaseDep) -> QualityCheck:
    """One check."""
    with database.read() as session:
        return store.document(store.QUALITY_CHECKS.get(session, quality_check_id))


@router.operation(
    "DELETE /quality-checks/{quality_check_id}", "delete-quality-check", "Delete a quality check"
)
@raises("unknown-quality-check")
def delete_quality_check(quality_check_id: CheckPath, database: DatabaseDep) -> None:
    """For one that was made wrongly: its values take no part in the charts any more."""
    with database.write() as session:
        session.delete(store.QUALITY_CHECKS.get(session, quality_check_id))


@router.operation(
    "GET /devices/{device_id}/quality", "get-quality", "Is a device as good as it was?"
)
@raises("unknown-device")
def get_quality(device_id: DevicePath, database: DatabaseDep) -> Quality:
    """Control charts of watching and checks with the active calibration, and recommendations."""
    with database.read() as session:
        get_device(session, device_id)
        return quality(session, device_id)


@router.operation(
    "GET /devices/{device_id}/quality.png",
    "get-quality-picture",
    "The control charts of a device",
    responses={200: _PNG},
    response_class=Response,
)
@raises("unknown-device")
def get_quality_picture(device_id: DevicePath, database: DatabaseDep) -> Response:
    """The charts of `quality` as PNG."""
    from service.api.quality.control_chart_plot import plot_control_charts

    with database.read() as session:
        get_device(session, device_id)
        found = quality(session, device_id)
    return Response(plot_control_charts(found), media_type="image/png")


@router.operation("GET /devices/{device_id}/watch", "get-watch", "How a device's drift is watched")
@raises("unknown-device")
def get_watch(device_id: DevicePath, database: DatabaseDep) -> WatchSettings:
    """The settings; the defaults while nobody has changed them."""
    with database.read() as session:
        get_device(session, device_id)
        return store.watch_of(session, device_id)


@router.operation(
    "PUT /devices/{device_id}/watch", "set-watch", "Say how a device's drift is watched"
)
@raises("unknown-device")
@raises("precondition-failed", "precondition-required", "invalid-precondition")
def set_watch(
    device_id: DevicePath,
    request: WatchBody,
    database: DatabaseDep,
    expected: RequiredIfMatch,
) -> WatchSettings:
    """Takes effect within seconds; what was watched before stays in the charts."""
    with database.write() as session:
        get_device(session, device_id, lock=True)
        expected.check(store.watch_of(session, device_id))
        store.set_watch(session, device_id, request)
    return request


@router.operation("GET /watch-samples", "list-watch-samples", "List what the watch saw")
def list_watch_samples(
    database: DatabaseDep, paging: PagingDep, device_id: DeviceFilter = None
) -> Page[WatchSample]:
    """One for each interval of a running device, newest first."""
    with database.read() as session:
        return page_of(session, store.samples(device_id), paging, store.sample, LATEST_FIRST)
