"""REST resource /api/v1/captures: place, hold, capture, next."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from threading import Lock
from typing import Annotated, Protocol

from fastapi import Body, Query, Response

from service.api.captures import store
from service.api.captures.averaging import average, to_captured
from service.api.captures.examples import NEW_CAPTURES
from service.api.captures.schema import (
    Capture,
    CapturedTarget,
    CaptureSettings,
    NewCapture,
)
from service.api.devices.driver_factory import recording_path
from service.api.devices.schema import Sensor
from service.api.devices.store import get_device, sensors_of_row
from service.api.inputs import (
    DatabaseDep,
    DeviceFilter,
    JsonTypes,
    LiveDep,
    SettingsDep,
    id_in_path,
    of_application,
)
from service.api.openapi import ResourceRouter, raises
from service.api.paging import Page, PagingDep, page_of
from service.problems.errors import (
    Busy,
    NoObservation,
)

router = ResourceRouter("/api/v1/captures", "captures")

NewCaptureBody = Annotated[NewCapture, JsonTypes(), Body(openapi_examples=NEW_CAPTURES)]
CapturePath = Annotated[str, id_in_path("The session's id.", "sim-capture", "frame")]


class RecordedTargets(Protocol):
    """Finds the targets of a session in a recording."""

    def captured(
        self, path: Path, request: NewCapture, sensors: Sequence[Sensor]
    ) -> list[CapturedTarget]:
        """Return what a recording has of a session's targets.

        Args:
            path: the recording.
            request: the session to begin.
            sensors: of its device.
        """
        ...


RecordedTargetsDep = Annotated[RecordedTargets, of_application("target_extraction")]

_capturing: set[str] = set()
_guard = Lock()


@router.operation("GET", "list-captures", "List capture sessions")
def list_captures(
    database: DatabaseDep, paging: PagingDep, device_id: DeviceFilter = None
) -> Page[Capture]:
    """Capture sessions, newest first."""
    with database.read() as session:
        return page_of(
            session, store.CAPTURES.newest_first(device_id=device_id), paging, store.document
        )


@router.operation("POST", "create-capture", "Begin a capture session", status_code=201)
@raises("unknown-device", "capture-exists", "duplicate-point", "unknown-recording")
@raises("invalid-recording", "invalid-parameter", "sensors-changed", "nothing-seen", "target-moved")
@raises("marker-not-moved", "busy")
def create_capture(
    request: NewCaptureBody,
    database: DatabaseDep,
    settings: SettingsDep,
    recorded: RecordedTargetsDep,
    response: Response,
) -> Capture:
    """Name the places at which a marker will be held, in the order in which they will be visited.

    Then, for each: place the marker, hold it, POST `capture`. When all are done, name the session
    as `capture_id` of a calibration or mapping run. With `recording_id` all targets are captured at
    once, from a recording with scans in which the markers rest at them.
    """
    captured: Sequence[CapturedTarget] = ()
    if request.recording_id is not None:
        path = recording_path(request.recording_id, settings.folders.recordings)
        with database.read() as session:
            sensors = sensors_of_row(get_device(session, request.device_id))
        captured = recorded.captured(path, request, sensors)
    with database.write() as session:
        device = get_device(session, request.device_id, lock=True)
        made = store.document(store.add_capture(session, request, device, captured))
    response.headers["Location"] = f"/api/v1/captures/{made.id}"
    return made


@router.operation("GET /{capture_id}", "get-capture", "What is captured and what is left")
@raises("unknown-capture")
def get_capture(capture_id: CapturePath, database: DatabaseDep) -> Capture:
    """One session."""
    with database.read() as session:
        return store.document(store.CAPTURES.get(session, capture_id))


@router.operation("DELETE /{capture_id}", "delete-capture", "Delete a capture session")
@raises("unknown-capture")
def delete_capture(capture_id: CapturePath, database: DatabaseDep) -> None:
    """Delete a session; runs that were posted with it keep its measurements."""
    with database.write() as session:
        session.delete(store.CAPTURES.get(session, capture_id, lock=True))


@router.operation("POST /{capture_id}/capture", "capture-target", "Capture the next target")
@raises("unknown-capture", "unknown-target", "device-not-running", "capture-of-another-device")
@raises("capture-complete", "nothing-seen", "target-moved", "marker-not-moved", "busy")
def capture_target(
    capture_id: CapturePath,
    database: DatabaseDep,
    live: LiveDep,
    target: Annotated[
        str | None,
        Query(
            min_length=1,
            max_length=64,
            pattern=r"^[^\u0000]*$",
            description="A target by name, also again; left out: the next that is not captured.",
        ),
    ] = None,
) -> Capture:
    """Average the readings of the marker over the next frames of the running device.

    The marker must rest: readings that spread or drift by more than their noise explains are
    refused, and nothing is stored. So are readings that equal another target's within their noise:
    the marker is still there, or a strobed one is named for both.
    """
    with database.read() as session:
        row = store.CAPTURES.get(session, capture_id)
        store.check_sensors_now(session, row)
        wanted = store.next_target(row, target)
        settings = CaptureSettings.model_validate(row.settings)
        marker = wanted.marker if wanted.marker is not None else settings.marker
        device, names = row.device_id, [sensor["name"] for sensor in row.sensors]
        created = row.created_at
    with _exclusive(device):
        position, sigma = live.collect(device, settings.frames, marker, settings.timeout_s)
    if len(position) < settings.frames:
        which = "all markers lit" if marker is None else f"marker {marker} lit"
        raise NoObservation(
            f"{len(position)} of {settings.frames} frames with {which} came within "
            f"{settings.timeout_s:g} s; choose the marker that the device strobes, or fewer frames",
            target=wanted.name,
            frames=len(position),
        )
    found = average(position, sigma, names, settings.seen_share, wanted.name)
    taken = to_captured(wanted.name, found, names, datetime.now(UTC))
    with database.write() as session:
        row = store.get_same(session, store.CAPTURES, capture_id, created)
        return store.document(store.keep(session, row, taken))


@contextmanager
def _exclusive(device_id: str) -> Iterator[None]:
    """Capture one target of a device at a time: two would be of one marker."""
    with _guard:
        if device_id in _capturing:
            raise Busy(f'a target of device "{device_id}" is being captured; wait until it is done')
        _capturing.add(device_id)
    try:
        yield
    finally:
        with _guard:
            _capturing.discard(device_id)
