"""Radiometric calibrations in the database: stored, read, activated; never changed."""

import secrets
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

from sqlalchemy.orm import Session

from hardware.driver import SensorDescription
from service.api.base_models import from_attributes
from service.api.devices.schema import listed
from service.api.devices.store import (
    active_radiometric_id,
    get_device,
    sensors_of_row,
)
from service.api.radiometric_calibrations.content import RadiometricContent, content_of
from service.api.radiometric_calibrations.schema import (
    RadiometricCalibrationDocument,
    RadiometricCalibrationSummary,
)
from service.database.engine import Resource
from service.database.models import RadiometricActivationRow, RadiometricCalibrationRow
from service.database.referrers import refuse_if_referred
from service.pipeline.active_calibration import ActiveRadiometric
from service.problems.errors import (
    ActivationConflict,
    RadiometricCalibrationExists,
    RadiometricCalibrationInUse,
    SensorsChanged,
    UnknownRadiometricCalibration,
)

RADIOMETRIC_CALIBRATIONS = Resource(
    RadiometricCalibrationRow,
    "radiometric",
    UnknownRadiometricCalibration,
    RadiometricCalibrationExists,
    "radiometric calibration",
    "exists already and is never overwritten; choose another id, or leave it out",
    "/api/v1/radiometric-calibrations",
)


def add_radiometric_calibration(
    session: Session,
    content: RadiometricContent,
    origin: str,
    note: str,
    radiometric_id: str | None = None,
) -> RadiometricCalibrationRow:
    """Store a radiometric calibration; it is not activated.

    Raises:
        UnknownDevice: its device was deleted meanwhile.
        RadiometricCalibrationExists: the id is taken.
        SensorsChanged: the device has other sensors.
    """
    device = get_device(session, content.device, lock=True)
    check_content(content, sensors_of_row(device))
    row = RadiometricCalibrationRow(
        id=radiometric_id or f"radiometric-{secrets.token_hex(8)}",
        device_id=content.device,
        origin=origin,
        summary=[figures.model_dump(mode="json") for figures in content.figures()],
        content=content.document(),
        content_hash=content.content_hash(),
        note=note,
        created_at=datetime.now(UTC),
    )
    return RADIOMETRIC_CALIBRATIONS.insert(session, row)


def delete_radiometric_calibration(session: Session, radiometric_id: str) -> None:
    """Delete a radiometric calibration to which nothing refers.

    Raises:
        UnknownRadiometricCalibration.
        RadiometricCalibrationInUse: it was active once, or is.
    """
    row = RADIOMETRIC_CALIBRATIONS.get(session, radiometric_id)
    get_device(session, row.device_id, lock=True)
    moves = RadiometricActivationRow
    advice = "only one that was never active can be deleted; deactivate it to use it no more"
    refuse_if_referred(
        session,
        RadiometricCalibrationInUse,
        row,
        advice,
        {"activations": (moves, moves.radiometric_id == row.id)},
    )
    session.delete(row)
    session.flush()


def check_content(content: RadiometricContent, now: Sequence[SensorDescription]) -> None:
    """Check that a radiometric calibration is of sensors that its device has now.

    Raises:
        SensorsChanged: a sensor is not one of them, or has another number of pixels.
    """
    pixels = {sensor.name: sensor.pixels for sensor in now}
    for name, one in content.sensors.items():
        if pixels.get(name) != one.pixels:
            raise SensorsChanged(
                f'device "{content.device}" has the sensors {listed(now)}; the radiometric '
                f'calibration is of "{name}" ({one.pixels} px): calibrate the sensors that the '
                "device has now",
                device_id=content.device,
                sensor=name,
            )


def activate(
    session: Session, row: RadiometricCalibrationRow, expected: str | None
) -> RadiometricCalibrationRow:
    """Let its device use a radiometric calibration; the device is locked.

    Activating what is active already changes nothing and writes nothing.

    Raises:
        ActivationConflict: another one is active than expected.
        SensorsChanged: the device has other sensors.
    """
    check_content(content_of(row.content), sensors_of_row(get_device(session, row.device_id)))
    _move(session, row.device_id, row.id, expected)
    return row


def deactivate(session: Session, row: RadiometricCalibrationRow) -> RadiometricCalibrationRow:
    """Let its device go on without it; one that is not active stays so. The device is locked."""
    if active_radiometric_id(session, row.device_id) == row.id:
        _move(session, row.device_id, None, None)
    return row


def _move(session: Session, device_id: str, target: str | None, expected: str | None) -> None:
    now = active_radiometric_id(session, device_id)
    if now == target:
        return
    if expected is not None and now != expected:
        shown = "none" if now is None else f'"{now}"'
        raise ActivationConflict(
            f'device "{device_id}" uses the radiometric calibration {shown}, not "{expected}" as '
            "the request expects; look at its radiometric activations, and ask again",
            device_id=device_id,
            expected=expected,
            active=now,
        )
    session.add(
        RadiometricActivationRow(
            device_id=device_id,
            radiometric_id=target,
            previous_radiometric_id=now,
            activated_at=datetime.now(UTC),
            actor=None,
        )
    )
    session.flush()


def active_radiometric(session: Session, radiometric_id: str) -> ActiveRadiometric:
    """Return a radiometric calibration as the pipeline takes it."""
    row = RADIOMETRIC_CALIBRATIONS.get(session, radiometric_id)
    return ActiveRadiometric(row.id, content_of(row.content).sensors, row.content_hash, row.content)


def summary(session: Session, row: RadiometricCalibrationRow) -> RadiometricCalibrationSummary:
    """Return a radiometric calibration without its pixels."""
    return from_attributes(RadiometricCalibrationSummary, row, **_members(session, row))


def document(session: Session, row: RadiometricCalibrationRow) -> RadiometricCalibrationDocument:
    """Return a radiometric calibration, whole."""
    return from_attributes(RadiometricCalibrationDocument, row, **_members(session, row))


def _members(session: Session, row: RadiometricCalibrationRow) -> dict[str, Any]:
    return {
        "active": active_radiometric_id(session, row.device_id) == row.id,
        "sensors": row.summary,
    }
