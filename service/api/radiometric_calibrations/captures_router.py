"""REST resource /api/v1/radiometric-captures: cover or light the sensors, capture, next."""

from typing import Annotated

from fastapi import Body, Query, Response

from service.api.captures.store import check_sensors_now, get_same
from service.api.devices.store import get_device
from service.api.inputs import (
    DatabaseDep,
    DeviceFilter,
    JsonTypes,
    LiveDep,
    id_in_path,
)
from service.api.openapi import ResourceRouter, raises
from service.api.paging import Page, PagingDep, page_of
from service.api.radiometric_calibrations import capture_store as store
from service.api.radiometric_calibrations.capture_checks import (
    Kind,
    check_dark,
    check_frame_count,
)
from service.api.radiometric_calibrations.examples import NEW_RADIOMETRIC_CAPTURES
from service.api.radiometric_calibrations.frame_tap import FrameTap
from service.api.radiometric_calibrations.schema import (
    NewRadiometricCapture,
    RadiometricCapture,
    RadiometricCaptureSettings,
)
from service.pipeline.tap_collection import collect

router = ResourceRouter("/api/v1/radiometric-captures", "radiometric-calibrations")

NewCaptureBody = Annotated[
    NewRadiometricCapture, JsonTypes(), Body(openapi_examples=NEW_RADIOMETRIC_CAPTURES)
]
CapturePath = Annotated[
    str, id_in_path("The session's id.", "sim-radiometric-capture", "radiometric-capture")
]


@router.operation("GET", "list-radiometric-captures", "List sessions of dark and flat captures")
def list_captures(
    database: DatabaseDep, paging: PagingDep, device_id: DeviceFilter = None
) -> Page[RadiometricCapture]:
    """Sessions, newest first."""
    with database.read() as session:
        rows = store.RADIOMETRIC_CAPTURES.newest_first(device_id=device_id)
        return page_of(session, rows, paging, store.document)


@router.operation(
    "POST", "create-radiometric-capture", "Begin dark and flat captures", status_code=201
)
@raises("unknown-device", "radiometric-capture-exists")
def create_capture(
    request: NewCaptureBody, database: DatabaseDep, response: Response
) -> RadiometricCapture:
    """Begin a session. Then do what `instruction` says and POST `capture`, until `next` is null.

    At the end name the session in a radiometric calibration.
    """
    with database.write() as session:
        device = get_device(session, request.device_id, lock=True)
        made = store.document(store.add_capture(session, request, device))
    response.headers["Location"] = f"/api/v1/radiometric-captures/{made.id}"
    return made


@router.operation(
    "GET /{radiometric_capture_id}", "get-radiometric-capture", "What is captured and what is next"
)
@raises("unknown-radiometric-capture")
def get_capture(radiometric_capture_id: CapturePath, database: DatabaseDep) -> RadiometricCapture:
    """One session."""
    with database.read() as session:
        return store.document(store.RADIOMETRIC_CAPTURES.get(session, radiometric_capture_id))


@router.operation(
    "DELETE /{radiometric_capture_id}", "delete-radiometric-capture", "Delete a session of captures"
)
@raises("unknown-radiometric-capture")
def delete_capture(radiometric_capture_id: CapturePath, database: DatabaseDep) -> None:
    """Delete a session; radiometric calibrations that were estimated from it stay."""
    with database.write() as session:
        session.delete(store.RADIOMETRIC_CAPTURES.get(session, radiometric_capture_id, lock=True))


@router.operation(
    "POST /{radiometric_capture_id}/capture",
    "capture-radiometric-frames",
    "Capture dark or flat frames",
)
@raises("unknown-radiometric-capture", "device-not-running", "capture-of-another-device")
@raises("radiometric-capture-incomplete", "unusable-radiometric-capture", "not-ready")
def capture_frames(
    radiometric_capture_id: CapturePath,
    database: DatabaseDep,
    live: LiveDep,
    kind: Annotated[
        Kind | None,
        Query(
            description="`dark`: the sensors are covered. `flat`: they are lit evenly. Left out: "
            "what is next."
        ),
    ] = None,
    name: Annotated[
        str | None,
        Query(
            pattern=r"^flat-[1-9][0-9]?$",
            description="A flat capture to take again; left out: one more.",
        ),
    ] = None,
    temperature_c: Annotated[
        float | None, Query(ge=-100.0, le=200.0, description="Of the sensors [°C], if known.")
    ] = None,
    relative_light: Annotated[
        float | None,
        Query(
            gt=0.0,
            le=1e12,
            description="Light of this level in any unit, by the lamp or the exposure time. Only "
            "where all flat captures have it something is known of the linearity.",
        ),
    ] = None,
) -> RadiometricCapture:
    """Take the next frames of the running device, and keep each pixel's mean and variance.

    They are checked at once, and refused with the reason: light in the dark frames; flat frames
    that are saturated, too dark, uneven or flicker. Nothing is stored then; a new dark capture
    drops the flat ones.
    """
    with database.read() as session:
        row = store.RADIOMETRIC_CAPTURES.get(session, radiometric_capture_id)
        check_sensors_now(session, row)
        sensors = [sensor["name"] for sensor in row.sensors]
        kind = kind or store.document(row).next or "flat"
        store.capture_name(row, kind, name)  # refused before frames are waited for
        settings = RadiometricCaptureSettings.model_validate(row.settings)
        device_id, created = row.device_id, row.created_at
    running = live.session(device_id)
    tap = FrameTap(running.last_sequence, settings.frames, len(sensors))
    collect(live, running, tap, settings.timeout_s, tap.ended, tap.add_up)
    tap.add_up()
    check_frame_count(tap.sums.frames, settings.frames, f"device {device_id}")
    found = tap.sums.statistics()
    description = running.description
    full_scale = 2**description.bits - 1
    if kind == "dark":
        check_dark(found, sensors, description.offset_counts, full_scale)
    with database.write() as session:
        row = get_same(session, store.RADIOMETRIC_CAPTURES, radiometric_capture_id, created)
        # Named only now: another capture may have been stored meanwhile.
        taken = store.captured_frames(
            store.capture_name(row, kind, name),
            kind,
            found,
            sensors,
            full_scale,
            temperature_c,
            relative_light,
        )
        return store.document(store.keep(session, row, taken, found))
