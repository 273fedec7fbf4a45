"""Capture sessions in the database: begun, filled target by target, turned into control points."""

import secrets
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from math import dist
from typing import Any, TypeVar

from sqlalchemy.orm import Session

from compute.errors import DuplicatePoint
from service.api.base_models import from_attributes
from service.api.calibrations.schema import ControlPoint, Reading
from service.api.captures.averaging import MIN_POINT_DISTANCE_MM, check_marker_moved
from service.api.captures.schema import Capture, CapturedTarget, NewCapture, Target
from service.api.devices.store import get_device, sensors_of_row
from service.database.engine import Resource
from service.database.models import (
    CaptureRow,
    DeviceRow,
    RadiometricCaptureRow,
    WaveCaptureRow,
)
from service.problems.errors import (
    CaptureComplete,
    CaptureExists,
    CaptureIncomplete,
    CaptureOfAnotherDevice,
    UnknownCapture,
    UnknownTarget,
)

_MIN_SIGMA_PX = 1e-6
_AnyCaptureRow = CaptureRow | RadiometricCaptureRow | WaveCaptureRow
_Row = TypeVar("_Row", bound=_AnyCaptureRow)
ALL_CAPTURED = "All targets are captured: post a run with this capture_id."


CAPTURES = Resource(CaptureRow, "capture", UnknownCapture, CaptureExists, "capture session")


def add_capture(
    session: Session,
    request: NewCapture,
    device: DeviceRow,
    captured: Sequence[CapturedTarget] = (),
) -> CaptureRow:
    """Store a new session.

    Args:
        session: the session of the database.
        request: what to begin.
        device: its device.
        captured: what is captured already.

    Raises:
        CaptureExists: the id is taken.
        DuplicatePoint: two targets have one name, or one position.
        MarkerNotMoved: two targets were read the same.
    """
    names: set[str] = set()
    places: dict[tuple[float, float, float], str] = {}
    for target in request.targets:
        other = places.setdefault(target.position_mm, target.name)
        if target.name in names:
            raise DuplicatePoint(
                f'two targets are called "{target.name}"; give each a name of its own',
                point=target.name,
            )
        names.add(target.name)
        if other != target.name:
            raise DuplicatePoint(
                f'targets "{other}" and "{target.name}" have the same position '
                f"{target.position_mm} mm; give each once: a target can be captured again by name",
                point=target.name,
            )
    places_by_name = {target.name: target.position_mm for target in request.targets}
    for number, found in enumerate(captured):
        _check_moved(found, captured[:number], places_by_name)
    now = datetime.now(UTC)
    row = CaptureRow(
        id=request.id or f"capture-{secrets.token_hex(8)}",
        device_id=device.id,
        sensors=device.sensors,
        settings=request.settings.model_dump(mode="json"),
        targets=[target.model_dump(mode="json") for target in request.targets],
        recording_id=request.recording_id,
        captured={one.target: one.model_dump(mode="json") for one in captured},
        note=request.note,
        created_at=now,
        updated_at=now,
    )
    return CAPTURES.insert(session, row)


def next_target(row: CaptureRow, name: str | None) -> Target:
    """Return the target of a name, or the next that is not captured.

    Raises:
        UnknownTarget: there is none of the name.
        CaptureComplete: none is named, and all are captured.
    """
    targets = [Target.model_validate(target) for target in row.targets]
    if name is not None:
        found = next((target for target in targets if target.name == name), None)
        if found is None:
            raise UnknownTarget(
                f'session "{row.id}" has no target "{name}"; it has '
                f"{', '.join(target.name for target in targets)[:300]}",
                capture_id=row.id,
                target=name,
            )
        return found
    found = next((target for target in targets if target.name not in row.captured), None)
    if found is None:
        raise CaptureComplete(
            f'all {len(targets)} targets of session "{row.id}" are captured; name one to capture '
            "it again, or post a run",
            capture_id=row.id,
        )
    return found


def check_device(session: Session, row: _AnyCaptureRow, device_id: str) -> None:
    """Check that a session is of a device, and of the sensors that it has now.

    Raises:
        CaptureOfAnotherDevice: it is not.
    """
    if row.device_id != device_id:
        raise CaptureOfAnotherDevice(
            f'session "{row.id}" is of device "{row.device_id}", not of "{device_id}"',
            capture_id=row.id,
            device_id=row.device_id,
        )
    check_sensors_now(session, row)


def check_sensors_now(session: Session, row: _AnyCaptureRow) -> None:
    """Raise CaptureOfAnotherDevice when the device has other sensors than at the beginning."""
    now = sensors_of_row(get_device(session, row.device_id))
    names = [(sensor["name"], sensor["pixels"]) for sensor in row.sensors]
    if names != [(sensor.name, sensor.pixels) for sensor in now]:
        raise CaptureOfAnotherDevice(
            f'session "{row.id}" was begun with other sensors than device "{row.device_id}" has '
            "now; begin a new one",
            capture_id=row.id,
        )


def get_same(
    session: Session, resource: Resource[_Row], capture_id: str, created_at: datetime
) -> _Row:
    """Return the session for which something was captured, locked until the transaction's end.

    Args:
        session: the session of the database.
        resource: the kind of capture session.
        capture_id: its id.
        created_at: when it was created, as it was read before the capture.

    Raises:
        UnknownCapture, or that of the kind: it was deleted meanwhile, and perhaps created again.
    """
    row = resource.get(session, capture_id, lock=True)
    if row.created_at != created_at:
        raise resource.unknown(
            f'session "{capture_id}" was deleted and created again while its sensors were read; '
            "what was read is of the former one and was not kept; capture it again",
            **{f"{resource.key}_id": capture_id},
        )
    return row


def keep(session: Session, row: CaptureRow, found: CapturedTarget) -> CaptureRow:
    """Store the readings of a target in place of earlier ones; the row is locked.

    Raises:
        MarkerNotMoved: another target was read the same.
    """
    places = {target["name"]: target["position_mm"] for target in row.targets}
    others = [
        CapturedTarget.model_validate(row.captured[name]) for name in places if name in row.captured
    ]
    _check_moved(found, others, places)
    row.captured = {**row.captured, found.target: found.model_dump(mode="json")}
    row.updated_at = datetime.now(UTC)
    session.flush()
    return row


def _check_moved(
    found: CapturedTarget,
    others: Sequence[CapturedTarget],
    places: Mapping[str, Sequence[float]],
) -> None:
    """Raise MarkerNotMoved where a target elsewhere was read the same."""
    here = places[found.target]
    check_marker_moved(
        found, [one for one in others if dist(places[one.target], here) > MIN_POINT_DISTANCE_MM]
    )


def captured_points(
    session: Session, capture_id: str, device_id: str, *, incomplete: bool = False
) -> list[ControlPoint]:
    """Return the control points of a session: its targets with what was read of them.

    Args:
        session: the session of the database.
        capture_id: the capture session.
        device_id: the device that it must be of.
        incomplete: whether targets may be missing.

    Raises:
        UnknownCapture: there is none.
        CaptureOfAnotherDevice: it is of another device, or of other sensors.
        CaptureIncomplete: targets are missing.
    """
    row = CAPTURES.get(session, capture_id)
    check_device(session, row, device_id)
    left = [target["name"] for target in row.targets if target["name"] not in row.captured]
    if left and not incomplete:
        raise CaptureIncomplete(
            f'{len(left)} of {len(row.targets)} targets of session "{row.id}" are not captured: '
            f"{', '.join(left)[:300]}; capture them, or say allow_incomplete",
            capture_id=row.id,
            left=len(left),
        )
    points = []
    for target in row.targets:
        taken = row.captured.get(target["name"])
        if taken is not None:
            points.append(_point(Target.model_validate(target), taken))
    return points


def _point(target: Target, taken: dict[str, Any]) -> ControlPoint:
    found = CapturedTarget.model_validate(taken)
    return ControlPoint(
        name=target.name,
        position_mm=target.position_mm,
        readings={
            one.sensor: Reading(position_px=one.mean_px, sigma_px=max(one.sigma_px, _MIN_SIGMA_PX))
            for one in found.sensors
        },
    )


def document(row: CaptureRow) -> Capture:
    """Return the session as clients see it."""
    names = [target["name"] for target in row.targets]
    left = [name for name in names if name not in row.captured]
    return from_attributes(
        Capture,
        row,
        captured=[row.captured[name] for name in names if name in row.captured],
        next=left[0] if left else None,
        left=len(left),
        instruction=_instruction(next_target(row, left[0])) if left else ALL_CAPTURED,
    )


def _instruction(target: Target) -> str:
    """Return what a person is to do at a target."""
    x, y, z = target.position_mm
    which = "the marker" if target.marker is None else f"strobed marker {target.marker}"
    return f"Hold {which} still at {target.name}, ({x:g}, {y:g}, {z:g}) mm, and capture it."
