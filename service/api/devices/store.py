"""Devices in the database, their sensors, and the pointer to the active calibration and table."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Final

from pydantic import TypeAdapter
from sqlalchemy import Select, delete, select
from sqlalchemy.orm import Session

from service.api.base_models import from_attributes
from service.api.devices.schema import (
    Device,
    DeviceChange,
    NewDevice,
    Sensor,
    Source,
    sensors_match,
)
from service.api.devices.tracking_settings import Tracking
from service.database.engine import Resource
from service.database.models import (
    ActivationRow,
    ActiveCalibrationRow,
    CalibrationRow,
    CaptureRow,
    CorrectionTableRow,
    DeviceRow,
    DriftCheckRow,
    HoldRow,
    QualityCheckRow,
    RadiometricActivationRow,
    RadiometricCalibrationRow,
    RadiometricCaptureRow,
    ReconstructionRow,
    RegistrationRow,
    RunRow,
    ToolCalibrationRow,
    ToolRow,
    WatchRow,
    WatchSampleRow,
    WaveCaptureRow,
)
from service.database.referrers import Conditions, refuse_if_referred
from service.problems.errors import (
    CalibrationRetired,
    DeviceExists,
    DeviceInUse,
    DeviceRunning,
    NothingToRollBack,
    UnknownDevice,
)

_SOURCE: TypeAdapter[Source] = TypeAdapter(Source)
_SENSORS = TypeAdapter(list[Sensor])


DEVICES = Resource(
    DeviceRow,
    "device",
    UnknownDevice,
    DeviceExists,
    taken="exists already; choose another id, or PATCH it",
)
get_device = DEVICES.get


def devices() -> Select[DeviceRow]:
    """Return all devices."""
    return select(DeviceRow)


def add_device(session: Session, request: NewDevice, sensors: list[Sensor]) -> DeviceRow:
    """Store a device; raises DeviceExists."""
    now = datetime.now(UTC)
    row = DeviceRow(
        id=request.id,
        title=request.title,
        source=_SOURCE.dump_python(request.source, mode="json"),
        sensors=_SENSORS.dump_python(sensors, mode="json"),
        autostart=request.autostart,
        station=request.station,
        tracking=_stored(request.tracking),
        created_at=now,
        updated_at=now,
    )
    return DEVICES.insert(session, row)


def change_device(
    session: Session,
    device_id: str,
    change: DeviceChange,
    sensors: list[Sensor] | None,
    *,
    running: bool,
) -> DeviceRow:
    """Change what the request gives.

    Args:
        session: the session.
        device_id: the device.
        change: the request.
        sensors: those of a new source; None without one.
        running: whether the device runs, with the sensors that it has now.

    Raises:
        UnknownDevice.
        DeviceInUse: the new source has other sensors, and calibrations of the old ones exist.
        DeviceRunning: the new source has other sensors, and the device runs with the old ones.
    """
    row = get_device(session, device_id, lock=True)
    given = change.model_fields_set
    if "title" in given:
        row.title = change.title
    if "station" in given and change.station != row.station:
        if running:
            raise DeviceRunning(
                f'device "{device_id}" is running; stop it before it becomes that of another '
                "station",
                device_id=device_id,
            )
        row.station = change.station
    if "autostart" in given:
        row.autostart = change.autostart
    if "tracking" in given:
        row.tracking = _stored(_merged(tracking_of(row), change.tracking))
    if "source" in given and sensors is not None:
        described = _SENSORS.dump_python(sensors, mode="json")
        if described != row.sensors:
            advice = "changing its sensors would orphan them"
            _refuse_if_used(session, row, advice, _OF_ITS_SENSORS)
        if running and not sensors_match(sensors, sensors_of_row(row)):
            raise DeviceRunning(
                f'device "{device_id}" is running, and the new source has other sensors; stop the '
                "device first",
                device_id=device_id,
            )
        row.source = _SOURCE.dump_python(change.source, mode="json")
        row.sensors = described
    row.updated_at = datetime.now(UTC)
    session.flush()
    return row


def delete_device(session: Session, device_id: str, *, cascade: bool) -> None:
    """Delete a device; with ``cascade`` all that belongs to it, too.

    Raises:
        UnknownDevice.
        DeviceInUse: calibrations (radiometric ones, too), reconstructions, captures, runs, tools,
            registrations or holds belong to it, and ``cascade`` is not asked.
    """
    row = get_device(session, device_id, lock=True)
    if cascade:
        for table in (
            ReconstructionRow,
            RunRow,
            CaptureRow,
            WaveCaptureRow,
            ActivationRow,
            ActiveCalibrationRow,
            RadiometricActivationRow,
            RadiometricCalibrationRow,
            RadiometricCaptureRow,
            CorrectionTableRow,
            DriftCheckRow,
            QualityCheckRow,
            WatchSampleRow,
            HoldRow,
            RegistrationRow,
            ToolCalibrationRow,
            ToolRow,
            CalibrationRow,
        ):
            session.execute(delete(table).where(table.device_id == device_id))
    else:
        _refuse_if_used(session, row, "add ?cascade=true to delete them with it")
    session.execute(delete(WatchRow).where(WatchRow.device_id == device_id))
    session.delete(row)
    session.flush()


_BELONGING: Final[Mapping[str, type[Any]]] = {
    "calibrations": CalibrationRow,
    "reconstructions": ReconstructionRow,
    "radiometric calibrations": RadiometricCalibrationRow,
    "radiometric captures": RadiometricCaptureRow,
    "captures": CaptureRow,
    "wave captures": WaveCaptureRow,
    "runs": RunRow,
    "tools": ToolRow,
    "registrations": RegistrationRow,
    "holds": HoldRow,
}
"""What belongs to a device and is lost with it."""
_OF_ITS_SENSORS: Final = ("calibrations", "reconstructions", "radiometric calibrations")


def _refuse_if_used(
    session: Session, row: DeviceRow, advice: str, kinds: Iterable[str] = _BELONGING
) -> None:
    """Raise DeviceInUse where anything of these kinds belongs to a device."""
    tables = {kind: _BELONGING[kind] for kind in kinds}
    conditions: Conditions = {
        kind: (table, table.device_id == row.id) for kind, table in tables.items()
    }
    refuse_if_referred(session, DeviceInUse, row, advice, conditions)


def source_of(row: DeviceRow) -> Source:
    """Return the device's source.

    What was stored before lines were fitted names no method: its calibrations are of centres of
    gravity, and so are its peaks, until its source is changed.
    """
    source = row.source
    settings = source.get("settings")
    if settings and source["kind"] in ("simulated", "profile") and "peaks" not in settings:
        source = {**source, "settings": {**settings, "peaks": "centroid"}}
    return _SOURCE.validate_python(source)


def tracking_of(row: DeviceRow) -> Tracking:
    """Return the device's tracking settings; the defaults where none are stored."""
    return Tracking() if row.tracking is None else Tracking.model_validate(row.tracking)


def _merged(tracking: Tracking, change: Tracking) -> Tracking:
    """Return settings with the members that a request gives; the others stay."""
    given = {name: getattr(change, name) for name in change.model_fields_set}
    return tracking.model_copy(update=given)


def _stored(tracking: Tracking) -> dict[str, Any] | None:
    """Return the settings that differ from the defaults, as they are stored.

    Raises:
        InvalidParameter: the settings contradict one another.
    """
    tracking.tool_tracker()
    tracking.tracker()
    return tracking.model_dump(mode="json", exclude_defaults=True) or None


def sensors_of_row(row: DeviceRow) -> list[Sensor]:
    """Return the device's sensors."""
    return _SENSORS.validate_python(row.sensors)


def document(session: Session, row: DeviceRow) -> Device:
    """Return the device as clients see it."""
    pointer = active(session, row.id)
    return from_attributes(
        Device,
        row,
        source=source_of(row),
        sensors=sensors_of_row(row),
        tracking=tracking_of(row),
        active_calibration_id=pointer.calibration_id if pointer else None,
        active_table_id=pointer.table_id if pointer else None,
        active_radiometric_id=active_radiometric_id(session, row.id),
    )


def active_radiometric_id(session: Session, device_id: str) -> str | None:
    """Return the radiometric calibration that a device uses, None without one."""
    newest = session.scalars(radiometric_activations(device_id).limit(1)).first()
    return None if newest is None else newest.radiometric_id


def radiometric_activations(device_id: str) -> Select[RadiometricActivationRow]:
    """Return the changes of a device's radiometric calibration, newest first."""
    return (
        select(RadiometricActivationRow)
        .where(RadiometricActivationRow.device_id == device_id)
        .order_by(RadiometricActivationRow.id.desc())
    )


@dataclass(frozen=True)
class Target:
    """Calibration and correction table that become active.

    Args:
        calibration_id: the calibration.
        table_id: its correction table; None: without one.
        restores_id: the move of the history that is gone back to; None: a new one.
    """

    calibration_id: str
    table_id: str | None = None
    restores_id: int | None = None


def active(session: Session, device_id: str) -> Target | None:
    """Return what the device uses now, None without a calibration."""
    pointer = session.get(ActiveCalibrationRow, device_id, populate_existing=True)
    return None if pointer is None else Target(pointer.calibration_id, pointer.table_id)


def active_at(session: Session, device_id: str, moment: datetime) -> Target | None:
    """Return what the device used at a moment, None without a calibration."""
    found = session.scalars(
        activations(device_id).where(ActivationRow.activated_at <= moment).limit(1)
    ).first()
    return None if found is None else Target(found.calibration_id, found.table_id)


def lock_device(session: Session, device_id: str) -> None:
    """Let other moves of the pointer wait (SQLite: they do from the transaction's begin)."""
    session.execute(select(DeviceRow.id).where(DeviceRow.id == device_id).with_for_update())


def check_not_retired(row: CalibrationRow) -> None:
    """Raise CalibrationRetired when a calibration may not be activated any more."""
    if row.retired_at is not None:
        raise CalibrationRetired(
            f'calibration "{row.id}" was retired on {row.retired_at:%Y-%m-%d}; activate one that '
            "is available",
            calibration_id=row.id,
        )


def move_pointer(session: Session, device_id: str, target: Target) -> None:
    """Point the device to a calibration and table and write the move down; both or neither.

    Where it points there already nothing is changed or written. The device is locked.
    """
    pointer = session.get(ActiveCalibrationRow, device_id, populate_existing=True)
    before = None if pointer is None else (pointer.calibration_id, pointer.table_id)
    if before == (target.calibration_id, target.table_id):
        return
    if pointer is None:
        pointer = ActiveCalibrationRow(device_id=device_id)
        session.add(pointer)
    pointer.calibration_id, pointer.table_id = target.calibration_id, target.table_id
    session.add(
        ActivationRow(
            device_id=device_id,
            calibration_id=target.calibration_id,
            previous_calibration_id=before[0] if before else None,
            table_id=target.table_id,
            previous_table_id=before[1] if before else None,
            restores_id=target.restores_id,
            activated_at=datetime.now(UTC),
            actor=None,
        )
    )
    session.flush()


def previous_activation(session: Session, device_id: str) -> Target:
    """Return what the device used before its last move; raises NothingToRollBack.

    A move that was a roll-back stands where it went back to: rolling back again goes further.
    """
    newest = latest_activation(session, device_id)
    reached = newest and (newest.restores_id or newest.id)
    earlier = latest_activation(session, device_id, reached) if reached else None
    if earlier is None:
        raise NothingToRollBack(
            f'device "{device_id}" has no activation before the present one; activate a '
            "calibration by its id",
            device_id=device_id,
        )
    return Target(earlier.calibration_id, earlier.table_id, earlier.restores_id or earlier.id)


def latest_activation(
    session: Session, device_id: str, before: int | None = None
) -> ActivationRow | None:
    """Return the newest activation of a device, or the newest before one by its id."""
    query = activations(device_id)
    if before is not None:
        query = query.where(ActivationRow.id < before)
    return session.scalars(query.limit(1)).first()


def activations(device_id: str) -> Select[ActivationRow]:
    """Return a device's activations, newest first."""
    return (
        select(ActivationRow)
        .where(ActivationRow.device_id == device_id)
        .order_by(ActivationRow.id.desc())
    )
