"""REST resource /api/v1/recordings."""

from functools import partial
from typing import Annotated, Any, Final

from fastapi import Body, Path, Response
from starlette.responses import FileResponse

from service.api.devices import store
from service.api.devices.schema import RECORDING_PATTERN
from service.api.inputs import (
    DatabaseDep,
    DeviceFilter,
    DevicePath,
    JsonTypes,
)
from service.api.openapi import ResourceRouter, raises
from service.api.paging import Page, PagingDep
from service.api.recordings.recording_manager import RecordingsDep
from service.api.recordings.repository import replaying_devices
from service.api.recordings.schema import NewRecording, RecordingDetail, RecordingDocument

MEDIA_TYPE: Final = "application/x-hdf5"

router = ResourceRouter("/api/v1", "recordings")

_NEW_RECORDINGS: Final[dict[str, Any]] = {
    "whole": {
        "summary": "Lines and results, for a minute",
        "value": {"id": "first.h5", "contents": ["lines", "results"], "max_duration_s": 60.0},
    },
}
_FILE: Final = {MEDIA_TYPE: {"schema": {"type": "string", "format": "binary"}}}
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
@raises("insufficient-storage")
def start_recording(
    device_id: DevicePath,
    request: NewRecordingBody,
    database: DatabaseDep,
    recordings: RecordingsDep,
    response: Response,
) -> RecordingDetail:
    """Record a running device from its next frame on, until it is stopped or a limit is reached.

    Recording waits for nothing: where the disk does not keep up frames are missing in the file,
    which says how many, and the streams go on. The file can be read while it is written.
    """
    with database.read() as session:
        store.get_device(session, device_id)
    begun = recordings.start(device_id, request)
    response.headers["Location"] = f"/api/v1/recordings/{begun.id}"
    return begun


@router.operation("GET /recordings", "list-recordings", "List recordings")
def list_recordings(
    recordings: RecordingsDep, paging: PagingDep, device_id: DeviceFilter = None
) -> Page[RecordingDocument]:
    """Files `*.h5` below the folder `recordings`, whoever put them there, the newest first."""
    return recordings.page(device_id, paging)


# The paths that go on from a name come first: a name may have slashes in it.
@router.operation("POST /recordings/{recording_id:path}/stop", "stop-recording", "End a recording")
@raises("unknown-recording")
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
@raises("unknown-recording", "recording-in-progress")
def download_recording(recording_id: FinishedPath, recordings: RecordingsDep) -> FileResponse:
    """The file, or the part of it that the header `Range` asks for.

    Not while this server writes it: what was sent first and last would not fit together.
    """
    path = recordings.finished_path(recording_id)
    return FileResponse(path, media_type=MEDIA_TYPE, filename=path.name)


@router.operation("GET /recordings/{recording_id:path}", "get-recording", "Read about a recording")
@raises("unknown-recording")
def get_recording(recording_id: BegunPath, recordings: RecordingsDep) -> RecordingDetail:
    """What is in a recording, what was lost on the way, and why it ended."""
    return recordings.get(recording_id)


@router.operation(
    "DELETE /recordings/{recording_id:path}", "delete-recording", "Delete a recording"
)
@raises("unknown-recording", "recording-in-progress", "recording-in-use")
def delete_recording(
    recording_id: FinishedPath, database: DatabaseDep, recordings: RecordingsDep
) -> None:
    """Delete the file; not while it is written, or a device replays it."""
    recordings.delete(recording_id, partial(replaying_devices, database))
