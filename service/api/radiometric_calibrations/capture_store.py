"""Sessions of dark and flat captures in the database."""

import secrets
from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np
from sqlalchemy.orm import Session

from service.api.base_models import from_attributes
from service.api.captures.store import check_device
from service.api.radiometric_calibrations.capture_checks import Kind, check_flat
from service.api.radiometric_calibrations.frame_statistics import (
    FrameStatistics,
    pack_statistics,
    unpack_statistics,
)
from service.api.radiometric_calibrations.schema import (
    CapturedFrames,
    CapturedLevel,
    NewRadiometricCapture,
    RadiometricCapture,
    RadiometricCaptureSettings,
)
from service.database.engine import Resource
from service.database.models import DeviceRow, RadiometricCaptureRow
from service.problems.errors import (
    RadiometricCaptureExists,
    RadiometricCaptureIncomplete,
    UnknownRadiometricCapture,
    UnusableRadiometricCapture,
)

RADIOMETRIC_CAPTURES = Resource(
    RadiometricCaptureRow,
    "radiometric_capture",
    UnknownRadiometricCapture,
    RadiometricCaptureExists,
    "session of radiometric captures",
)
DARK = "dark"


def add_capture(
    session: Session, request: NewRadiometricCapture, device: DeviceRow
) -> RadiometricCaptureRow:
    """Store a new session, with nothing captured; raises RadiometricCaptureExists."""
    now = datetime.now(UTC)
    row = RadiometricCaptureRow(
        id=request.id or f"radiometric-capture-{secrets.token_hex(8)}",
        device_id=device.id,
        sensors=device.sensors,
        settings=request.settings.model_dump(mode="json"),
        captured=[],
        data=b"",
        note=request.note,
        created_at=now,
        updated_at=now,
    )
    return RADIOMETRIC_CAPTURES.insert(session, row)


def capture_name(row: RadiometricCaptureRow, kind: Kind, name: str | None) -> str:
    """Return the name under which a capture is kept.

    Args:
        row: the session.
        kind: what is captured.
        name: one that is captured again; None: the dark capture, or one more flat capture.

    Raises:
        UnusableRadiometricCapture: there is no flat capture of the name.
        RadiometricCaptureIncomplete: a flat capture comes before the dark one.
    """
    names = [one["name"] for one in row.captured]
    if kind == "dark":
        return DARK
    if DARK not in names:
        raise RadiometricCaptureIncomplete(
            f'session "{row.id}" has no dark capture yet, which flat ones are checked against: '
            "cover the sensors and capture kind=dark first",
            capture_id=row.id,
        )
    if name is not None:
        if name not in names or name == DARK:
            raise UnusableRadiometricCapture(
                f'session "{row.id}" has no flat capture "{name}" to capture again; it has '
                f"{', '.join(one for one in names if one != DARK) or 'none'}",
                capture_id=row.id,
                name=name,
            )
        return name
    taken = {one["name"] for one in row.captured}
    number = next(n for n in range(1, len(taken) + 2) if f"flat-{n}" not in taken)
    return f"flat-{number}"


def statistics_by_name(row: RadiometricCaptureRow) -> dict[str, FrameStatistics]:
    """Return the statistics of a session's captures."""
    return unpack_statistics(row.data)


def keep(
    session: Session,
    row: RadiometricCaptureRow,
    taken: CapturedFrames,
    found: FrameStatistics,
) -> RadiometricCaptureRow:
    """Store a capture in place of an earlier one of its name; the row is locked.

    A flat capture is checked against the dark one that is there now. A new dark capture drops the
    flat ones: they were checked against the earlier one.

    Raises:
        UnusableRadiometricCapture: a flat capture is unfit.
    """
    kept = {} if taken.kind == "dark" else statistics_by_name(row)
    if taken.kind == "flat":
        sensors = [one.sensor for one in taken.sensors]
        check_flat(found, sensors, kept[DARK], taken.full_scale_counts)
    kept[taken.name] = found
    others = [one for one in row.captured if one["name"] in kept and one["name"] != taken.name]
    row.captured = sorted(
        [*others, taken.model_dump(mode="json")],
        key=lambda one: (one["kind"], int(one["name"].partition("-")[2] or 0)),
    )
    row.data = pack_statistics(kept)
    row.updated_at = datetime.now(UTC)
    session.flush()
    return row


def captured_frames(
    name: str,
    kind: Kind,
    found: FrameStatistics,
    sensors: Sequence[str],
    full_scale: int,
    temperature_c: float | None,
    relative_light: float | None,
) -> CapturedFrames:
    """Return the document of a capture."""
    return CapturedFrames(
        name=name,
        kind=kind,
        frames=found.frames,
        temperature_c=temperature_c,
        relative_light=relative_light,
        full_scale_counts=full_scale,
        sensors=[
            CapturedLevel(
                sensor=sensor,
                mean_counts=float(np.median(pixels.mean)),
                noise_counts=float(np.sqrt(np.median(pixels.variance))),
                saturated_pixels=int(np.count_nonzero(pixels.maximum >= full_scale)),
                flicker=float(flicker),
            )
            for sensor, pixels, flicker in zip(sensors, found.sensors, found.flicker, strict=True)
        ],
        captured_at=datetime.now(UTC),
    )


def complete_captures(
    session: Session, capture_id: str, device_id: str
) -> tuple[RadiometricCaptureRow, list[CapturedFrames], dict[str, FrameStatistics]]:
    """Return a session from which a radiometric calibration of a device can be estimated.

    Raises:
        UnknownRadiometricCapture.
        CaptureOfAnotherDevice: it is of another device, or of other sensors than it has now.
        RadiometricCaptureIncomplete: captures are missing.
    """
    row = RADIOMETRIC_CAPTURES.get(session, capture_id)
    check_device(session, row, device_id)
    shown = document(row)
    if not any(one.kind == "dark" for one in shown.captured) or len(shown.captured) < 3:
        raise RadiometricCaptureIncomplete(
            f'session "{row.id}" has {len(shown.captured)} captures; the dark one and flat ones '
            f"at two levels of light at least are needed. {shown.instruction}",
            capture_id=row.id,
            left=shown.left,
        )
    return row, shown.captured, statistics_by_name(row)


def document(row: RadiometricCaptureRow) -> RadiometricCapture:
    """Return the session as clients see it, with what to do next."""
    captured = [CapturedFrames.model_validate(one) for one in row.captured]
    settings = RadiometricCaptureSettings.model_validate(row.settings)
    flats = sum(one.kind == "flat" for one in captured)
    if not captured:
        following: Kind | None = "dark"
        instruction = "Cover all sensors, switch the markers off, and capture kind=dark."
    elif flats < settings.levels:
        following = "flat"
        instruction = _flat_instruction(settings, captured)
    else:
        following = None
        instruction = (
            "There are enough captures. POST /api/v1/radiometric-calibrations with this session; "
            "more flat captures at other levels make it better."
        )
    return from_attributes(
        RadiometricCapture,
        row,
        captured=captured,
        next=following,
        instruction=instruction,
        left=max(0, settings.levels - flats) + (not captured),
    )


def _flat_instruction(
    settings: RadiometricCaptureSettings, captured: Sequence[CapturedFrames]
) -> str:
    """Return what to do for the level of light that is farthest from all captured ones."""
    dark = captured[0]
    offset = float(np.median([one.mean_counts for one in dark.sensors]))
    full = dark.full_scale_counts - offset
    levels = settings.max_level * np.arange(1, settings.levels + 1) / settings.levels
    there = [
        (float(np.median([one.mean_counts for one in flat.sensors])) - offset) / full
        for flat in captured[1:]
    ]
    distance = [min((abs(level - one) for one in there), default=level) for level in levels]
    wanted = float(levels[0] if not there else levels[int(np.argmax(distance))])
    return (
        f"Light all sensors evenly and steadily to about {wanted:.0%} of full scale "
        f"({offset + wanted * full:.0f} counts), and capture kind=flat."
    )
