"""REST resource /api/v1/wave-captures: begin, start, wave, stop, calibrate."""

from typing import Annotated

import numpy as np
from fastapi import Body, Response

from compute.calibration.self_calibration.strobed_poses import PoseCounts
from compute.calibration.self_calibration.targets import Recording
from compute.calibration.self_calibration.wave_coverage import wave_coverage
from compute.camera.model import SensorGeometry
from service.api.calibrations.calibration_content import result_of
from service.api.calibrations.store import active_id, get_calibration
from service.api.captures.store import check_sensors_now
from service.api.devices.device_service import DeviceServiceDep
from service.api.devices.store import get_device
from service.api.inputs import (
    DatabaseDep,
    DeviceFilter,
    JsonTypes,
    id_in_path,
    of_application,
)
from service.api.openapi import ResourceRouter, raises
from service.api.paging import Page, PagingDep, page_of
from service.api.wave_captures import store
from service.api.wave_captures.examples import NEW_WAVE_CAPTURES
from service.api.wave_captures.schema import (
    NewWaveCapture,
    WaveCapture,
    WaveProgress,
    WaveSettings,
    calibration_target,
)
from service.api.wave_captures.wave_capture_manager import (
    WaveCaptureManager,
    WaveTask,
    approximate_models,
    progress_of,
)
from service.database.models import DeviceRow, WaveCaptureRow

router = ResourceRouter("/api/v1/wave-captures", "captures")

NewWaveCaptureBody = Annotated[
    NewWaveCapture, JsonTypes(), Body(openapi_examples=NEW_WAVE_CAPTURES)
]
WaveCapturePath = Annotated[str, id_in_path("The session's id.", "sim-wave-capture", "wand")]
WavesDep = Annotated[WaveCaptureManager, of_application("wave_captures")]


@router.operation("GET", "list-wave-captures", "List captures of waved wands and bodies")
def list_captures(
    database: DatabaseDep, waves: WavesDep, paging: PagingDep, device_id: DeviceFilter = None
) -> Page[WaveCapture]:
    """Sessions, newest first."""

    def document(row: WaveCaptureRow) -> WaveCapture:
        return store.document(row, waves.progress(row.id))

    with database.read() as session:
        rows = store.WAVE_CAPTURES.newest_first(device_id=device_id)
        return page_of(session, rows, paging, document)


@router.operation(
    "POST", "create-wave-capture", "Begin a capture of a waved wand or body", status_code=201
)
@raises("unknown-device", "wave-capture-exists", "invalid-parameter")
def create_capture(
    request: NewWaveCaptureBody, database: DatabaseDep, response: Response
) -> WaveCapture:
    """Say what will be waved, and which strobed markers it has.

    Then POST `start` and wave it in front of the running device, through the whole volume and in
    all directions; GET the session meanwhile for what is covered and what is missing. When there
    is enough, name it as `wave_capture_id` of a self-calibration run.
    """
    markers = store.markers_of(request)
    with database.write() as session:
        device = get_device(session, request.device_id, lock=True)
        row = store.add_capture(session, request, device, _nothing(request, device, len(markers)))
        made = store.document(row)
    response.headers["Location"] = f"/api/v1/wave-captures/{made.id}"
    return made


@router.operation(
    "GET /{wave_capture_id}", "get-wave-capture", "What is covered and what is missing"
)
@raises("unknown-wave-capture", "device-elsewhere")
def get_capture(
    wave_capture_id: WaveCapturePath,
    database: DatabaseDep,
    waves: WavesDep,
    device_service: DeviceServiceDep,
) -> WaveCapture:
    """One session; while poses are taken, as it is now."""
    running = waves.progress(wave_capture_id)
    with database.read() as session:
        row = store.WAVE_CAPTURES.get(session, wave_capture_id)
        if row.ended is None:
            device_service.check_here(row.device_id)
        return store.document(row, running)


@router.operation("DELETE /{wave_capture_id}", "delete-wave-capture", "Cancel or delete a capture")
@raises("unknown-wave-capture", "device-elsewhere")
def delete_capture(
    wave_capture_id: WaveCapturePath,
    database: DatabaseDep,
    waves: WavesDep,
    device_service: DeviceServiceDep,
) -> None:
    """Delete a session, also while poses are taken; runs that were posted with it keep theirs."""
    with database.read() as session:
        device_service.check_here(store.WAVE_CAPTURES.get(session, wave_capture_id).device_id)
    waves.discard(wave_capture_id)
    with database.write() as session:
        session.delete(store.WAVE_CAPTURES.get(session, wave_capture_id, lock=True))


@router.operation(
    "POST /{wave_capture_id}/start", "start-wave-capture", "Take poses while it is waved"
)
@raises("unknown-wave-capture", "device-not-running", "capture-of-another-device")
@raises("invalid-parameter", "busy")
def start_capture(
    wave_capture_id: WaveCapturePath,
    database: DatabaseDep,
    waves: WavesDep,
    device_service: DeviceServiceDep,
) -> WaveCapture:
    """Take poses of the running device from now on, beside those that were taken before.

    A pose is taken when all markers of the target were read by three sensors or more within one
    strobe cycle and the target has moved by 2 % of the pixels since the pose before. It ends when
    nothing is missing, after `duration_s`, by `stop`, or when the device stops.
    """
    with database.read() as session:
        row = store.WAVE_CAPTURES.get(session, wave_capture_id)
        device_service.check_here(row.device_id)
        check_sensors_now(session, row)
        sensors = _sensors(row.sensors)
        active = active_id(session, row.device_id)
        models = (
            None if active is None else result_of(get_calibration(session, active).content).models
        )
        task = WaveTask(
            row.id,
            row.device_id,
            sensors,
            store.target_of(row),
            tuple(row.markers),
            WaveSettings.model_validate(row.settings),
            approximate_models(models, sensors),
        )
    progress = waves.start(task)
    with database.read() as session:
        return store.document(store.WAVE_CAPTURES.get(session, wave_capture_id), progress)


@router.operation("POST /{wave_capture_id}/stop", "stop-wave-capture", "Take no more poses")
@raises("unknown-wave-capture", "device-elsewhere")
def stop_capture(
    wave_capture_id: WaveCapturePath,
    database: DatabaseDep,
    waves: WavesDep,
    device_service: DeviceServiceDep,
) -> WaveCapture:
    """Take no more poses, and store those taken; nothing changes where none are being taken."""
    with database.read() as session:
        device_service.check_here(store.WAVE_CAPTURES.get(session, wave_capture_id).device_id)
    waves.stop(wave_capture_id)
    with database.read() as session:
        row = store.WAVE_CAPTURES.get(session, wave_capture_id)
        return store.document(row, waves.progress(wave_capture_id))


def _sensors(described: list[dict[str, object]]) -> tuple[SensorGeometry, ...]:
    return tuple(SensorGeometry(str(one["name"]), int(str(one["pixels"]))) for one in described)


def _nothing(request: NewWaveCapture, device: DeviceRow, markers: int) -> WaveProgress:
    """Return the progress of a session without poses."""
    sensors = _sensors(device.sensors)
    none = np.empty((0, markers, len(sensors)))
    coverage = wave_coverage(sensors, Recording(calibration_target(request.target), none))
    return progress_of(coverage, PoseCounts(), np.zeros((3, len(sensors)), dtype=np.intp))
