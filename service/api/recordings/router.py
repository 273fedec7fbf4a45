"""REST resource /api/v1/recordings."""

from functools import partial
from typing import Annotated, Any, Final

from fastapi import Body, Path, Query, Response
from starlette.responses import FileResponse

from service.api.base_models import SLUG_PATTERN
from service.api.calibrations.calibration_content import result_of
from service.api.calibrations.store import get_calibration
from service.api.devices import store
from service.api.devices.device_service import DeviceServiceDep
from service.api.devices.schema import RECORDING_PATTERN
from service.api.inputs import (
    DatabaseDep,
    DeviceFilter,
    DevicePath,
    JsonTypes,
    of_application,
)
from service.api.line_scans.live_scans import DetailQuery
from service.api.line_scans.schema import DeviceScans
from service.api.openapi import ResourceRouter, raises
from service.api.paging import Page, PagingDep
from service.api.recordings.playback import MAX_FRAMES, recorded_frames, recorded_scans
from service.api.recordings.recalculation import Recalculation
from service.api.recordings.recorded_tracking import recorded_tracking_of
from service.api.recordings.recording_manager import RecordingsDep
from service.api.recordings.repository import recording_referrers
from service.api.recordings.retention import RetentionDep
from service.api.recordings.schema import (
    NewRecording,
    RecordedFrames,
    RecordingDetail,
    RecordingDocument,
    RetentionDocument,
)
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.tracking_config import NO_TRACKING

MEDIA_TYPE: Final = "application/x-hdf5"

router = ResourceRouter("/api/v1", "recordings")

_NEW_RECORDINGS: Final[dict[str, Any]] = {
    "whole": {
        "summary": "Lines and results, for a minute",
        "value": {"id": "first.h5", "contents": ["lines", "results"], "max_duration_s": 60.0},
    },
}
_FILE: Final = {MEDIA_TYPE: {"schema": {"type": "string", "format": "binary"}}}
RecalculationDep = Annotated[Recalculation, of_application("recalculation")]
NewRecordingBody = Annotated[NewRecording, JsonTypes(), Body(openapi_examples=_NEW_RECORDINGS)]


def _name_in_path(example: str, name: str, summary: str) -> Any:
    return Path(
        pattern=RECORDING_PATTERN,
        max_length=200,
        description="File name below the folder `recordings`.",
        openapi_examples={name: {"summary": summary, "value": example}},
    )


BegunPath = Annotated[str, _name_in_path("first.h5", "begun", "begun before")]
FinishedPath = Annotated[str, _name_in_path("earlier.h5", "finished", "one in the folder")]


@router.operation(
    "POST /devices/{device_id}/recordings", "start-recording", "Record a device", status_code=201
)
@raises("unknown-device", "device-not-running", "recording-exists", "recording-in-progress")
@raises("insufficient-storage", "invalid-parameter")
def start_recording(
    device_id: DevicePath,
    request: NewRecordingBody,
    database: DatabaseDep,
    recordings: RecordingsDep,
    device_service: DeviceServiceDep,
    response: Response,
) -> RecordingDetail:
    """Record a running device from its next frame on, until it is stopped or a limit is reached.

    Recording waits for nothing: where the disk does not keep up frames are missing in the file,
    which says how many, and the streams go on. The file can be read while it is written.
    """
    with database.read() as session:
        store.get_device(session, device_id)
    device_service.check_here(device_id)
    begun = recordings.start(device_id, request)
    response.headers["Location"] = f"/api/v1/recordings/{begun.id}"
    return begun


@router.operation("GET /recordings", "list-recordings", "List recordings")
def list_recordings(
    recordings: RecordingsDep, paging: PagingDep, device_id: DeviceFilter = None
) -> Page[RecordingDocument]:
    """Files `*.h5` below the folder `recordings`, whoever put them there, the newest first."""
    return recordings.page(device_id, paging)


@router.operation(
    "GET /recording-retention", "get-recording-retention", "How long recordings are kept"
)
def get_recording_retention(retention: RetentionDep) -> RetentionDocument:
    """Limits of the settings, what the last check found, and what was deleted."""
    return retention.document()


# The paths that go on from a name come first: a name may have slashes in it.
@router.operation("POST /recordings/{recording_id:path}/stop", "stop-recording", "End a recording")
@raises("unknown-recording", "file-elsewhere")
def stop_recording(recording_id: BegunPath, recordings: RecordingsDep) -> RecordingDetail:
    """End a recording and close its file; one that has ended stays as it is."""
    return recordings.stop(recording_id)


@router.operation(
    "GET /recordings/{recording_id:path}/file",
    "download-recording",
    "Download a recording",
    responses={
        200: {"description": "The whole file.", "content": _FILE},
        206: {"description": "The part that the header `Range` asks for.", "content": _FILE},
    },
    response_class=FileResponse,
)
@raises("unknown-recording", "recording-in-progress", "file-elsewhere")
def download_recording(recording_id: FinishedPath, recordings: RecordingsDep) -> FileResponse:
    """The file, or the part of it that the header `Range` asks for.

    Not while this server writes it: what was sent first and last would not fit together.
    """
    path = recordings.finished_path(recording_id)
    return FileResponse(path, media_type=MEDIA_TYPE, filename=path.name)


@router.operation(
    "GET /recordings/{recording_id:path}/frames",
    "get-recorded-frames",
    "Look at frames of a recording",
    response_model=RecordedFrames,
)
@raises("unknown-recording", "invalid-recording", "invalid-parameter", "unknown-calibration")
@raises("sensors-changed", "busy", "file-elsewhere")
def get_recorded_frames(
    recording_id: FinishedPath,
    recordings: RecordingsDep,
    database: DatabaseDep,
    recalculation: RecalculationDep,
    first: Annotated[
        int, Query(ge=0, lt=2**53, description="Number of the first frame, from 0.", examples=[0])
    ] = 0,
    count: Annotated[int, Query(ge=1, le=MAX_FRAMES, description="How many frames, at most.")] = 32,
    calibration_id: Annotated[
        str | None,
        Query(
            pattern=SLUG_PATTERN,
            description="A calibration of the same sensors: points are worked out with it from the "
            "recorded peaks, without a correction table. Left out: those of the recording.",
        ),
    ] = None,
    tracking: Annotated[
        bool,
        Query(
            description="Also the tracks of markers and the poses of tools: of the tools that the "
            "device has now, with its settings of tracking. They and the points are worked out "
            "now, from the recorded peaks, or from the scans where there are none.",
        ),
    ] = False,
) -> Response:
    """Consecutive frames with their points, for a player.

    The points are the recorded ones, which were found live; with `tracking` or `calibration_id`
    all results are worked out now. Only so there are points of a recording without results.
    Tracks and tools go on from the frames of earlier requests; after a jump they begin some hundred
    frames before the first. Damaged frames before the first are left out.
    """
    path = recordings.path(recording_id)
    if calibration_id is None and not tracking:
        document = recorded_frames(path, recording_id, first, count).model_dump_json()
    else:
        calibration, config = None, NO_TRACKING
        device_id = recordings.library.document(recording_id).device_id
        with database.read() as session:
            if calibration_id is not None:
                row = get_calibration(session, calibration_id)
                calibration = ActiveCalibration(row.id, result_of(row.content))
            if tracking:
                config = recorded_tracking_of(session, device_id)
        document = recalculation.frames(path, recording_id, first, count, calibration, config)
    return Response(document, media_type="application/json")


@router.operation(
    "GET /recordings/{recording_id:path}/scans",
    "get-recorded-scans",
    "Look at the scans of a recorded frame",
    response_model=DeviceScans,
)
@raises("unknown-recording", "invalid-recording", "invalid-parameter", "file-elsewhere")
def get_recorded_scans(
    recording_id: FinishedPath,
    recordings: RecordingsDep,
    number: Annotated[
        int, Query(ge=0, lt=2**53, description="The frame's number, from 0.", examples=[0])
    ] = 0,
    detail_sensor: DetailQuery = None,
) -> Response:
    """The pixels of one recorded exposure, as `/devices/{device_id}/scans` has those of a live one.

    Peaks are the recorded ones; without results they are found now. Levels and fits are those
    without a radiometric calibration.
    """
    path = recordings.path(recording_id)
    found = recorded_scans(path, recording_id, number, detail_sensor)
    return Response(found.model_dump_json(), media_type="application/json")


@router.operation("GET /recordings/{recording_id:path}", "get-recording", "Read about a recording")
@raises("unknown-recording")
def get_recording(recording_id: BegunPath, recordings: RecordingsDep) -> RecordingDetail:
    """Content of a recording, its losses, and why it ended."""
    return recordings.get(recording_id)


@router.operation(
    "DELETE /recordings/{recording_id:path}", "delete-recording", "Delete a recording"
)
@raises("unknown-recording", "recording-in-progress", "recording-in-use", "file-elsewhere")
def delete_recording(
    recording_id: FinishedPath, database: DatabaseDep, recordings: RecordingsDep
) -> None:
    """Delete the file; not while it is written, a device replays it, or an open run reads it."""
    recordings.delete(recording_id, partial(recording_referrers, database))
