"""Wave captures in the database: begun, filled with poses, turned into readings of a run."""

import secrets
from datetime import UTC, datetime

from pydantic import TypeAdapter
from sqlalchemy.orm import Session

from compute.calibration.self_calibration.targets import CalibrationTarget
from compute.calibration.self_calibration.wave_coverage import MIN_POSES
from compute.errors import InvalidParameter
from service.api.base_models import from_attributes
from service.api.captures.store import check_device
from service.api.wave_captures.schema import (
    BodyTarget,
    MovedTarget,
    NewWaveCapture,
    UnknownTarget,
    WandTarget,
    WaveCapture,
    WaveProgress,
    WaveState,
    calibration_target,
)
from service.api.wave_captures.stored_wave import StoredWave
from service.database.engine import Resource
from service.database.models import DeviceRow, WaveCaptureRow
from service.problems.errors import CaptureIncomplete, UnknownWaveCapture, WaveCaptureExists

WAVE_CAPTURES = Resource(
    WaveCaptureRow, "wave_capture", UnknownWaveCapture, WaveCaptureExists, "wave capture"
)
_TARGET: TypeAdapter[WandTarget | BodyTarget | UnknownTarget] = TypeAdapter(MovedTarget)


def add_capture(
    session: Session, request: NewWaveCapture, device: DeviceRow, progress: WaveProgress
) -> WaveCaptureRow:
    """Store a new session, with no poses.

    Raises:
        WaveCaptureExists: the id is taken.
    """
    now = datetime.now(UTC)
    markers = markers_of(request)
    row = WaveCaptureRow(
        id=request.id or f"wave-capture-{secrets.token_hex(8)}",
        device_id=device.id,
        sensors=device.sensors,
        target=request.target.model_dump(mode="json"),
        markers=list(markers),
        settings=request.settings.model_dump(mode="json"),
        progress=progress.model_dump(mode="json"),
        ended=None,
        data=StoredWave.empty(len(markers), len(device.sensors)).pack(),
        note=request.note,
        created_at=now,
        updated_at=now,
    )
    return WAVE_CAPTURES.insert(session, row)


def markers_of(request: NewWaveCapture) -> tuple[int, ...]:
    """Return the strobed marker of each of the target's markers.

    Raises:
        InvalidParameter: there are more or fewer than the target has, or one is given twice.
    """
    count = len(calibration_target(request.target))
    markers = tuple(range(count)) if request.markers is None else tuple(request.markers)
    if len(markers) != count:
        raise InvalidParameter(
            f"markers has {len(markers)} numbers; the target has {count} markers: give the "
            "strobed marker of each",
            markers=len(markers),
        )
    if len(set(markers)) != count:
        raise InvalidParameter(f"markers {list(markers)} has one twice; each has its own number")
    return markers


def target_of(row: WaveCaptureRow) -> CalibrationTarget:
    """Return the target that is waved."""
    return calibration_target(_TARGET.validate_python(row.target))


def keep_wave(
    session: Session, capture_id: str, taken: StoredWave, progress: WaveProgress, ended: str
) -> None:
    """Store all that was taken; nothing happens where the session was deleted meanwhile."""
    row = session.get(WaveCaptureRow, capture_id, with_for_update=True)
    if row is None:
        return
    row.data = taken.pack()
    row.progress = progress.model_dump(mode="json")
    row.ended = ended
    row.updated_at = datetime.now(UTC)
    session.flush()


def captured_recording(
    session: Session, capture_id: str, device_id: str
) -> tuple[WandTarget | BodyTarget | UnknownTarget, StoredWave]:
    """Return the target of a session and the poses taken of it.

    Raises:
        UnknownWaveCapture: there is none.
        CaptureOfAnotherDevice: it is of another device, or of other sensors than it has now.
        CaptureIncomplete: no poses were taken yet.
    """
    row = WAVE_CAPTURES.get(session, capture_id)
    check_device(session, row, device_id)
    taken = StoredWave.unpack(row.data)
    if len(taken.readings_px) == 0:
        raise CaptureIncomplete(
            f'session "{row.id}" has no poses; start it, wave the target, and stop it',
            capture_id=row.id,
            left=MIN_POSES,
        )
    return _TARGET.validate_python(row.target), taken


def document(row: WaveCaptureRow, running: WaveProgress | None = None) -> WaveCapture:
    """Return the session as clients see it.

    Args:
        row: the session.
        running: what is covered, while poses are being taken; None: none are.
    """
    progress = running or WaveProgress.model_validate(row.progress)
    state: WaveState = "ready" if row.ended is None else "stopped"
    if running is not None:
        state = "capturing"
    return from_attributes(
        WaveCapture,
        row,
        target=_TARGET.validate_python(row.target),
        state=state,
        ended=None if running is not None else row.ended,
        progress=progress,
        left=max(0, progress.wanted_poses - progress.poses),
        instruction=_instruction(state, progress),
    )


def _instruction(state: WaveState, progress: WaveProgress) -> str:
    """Return what a person is to do now."""
    if state == "ready":
        return "Start it, and wave the target through the whole volume, in all directions."
    if state == "capturing":
        if progress.enough:
            return "That is enough: stop it, and post a self-calibration run with it."
        return f"Wave on. {progress.missing[0]}"
    if progress.enough:
        return "That is enough: post a self-calibration run with this wave_capture_id."
    return f"Start it again and wave on. {progress.missing[0]}"
