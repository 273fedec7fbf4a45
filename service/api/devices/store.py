"""Devices in the database."""

from datetime import UTC, datetime
from typing import Any

from pydantic import TypeAdapter
from sqlalchemy import Select, delete, func, select
from sqlalchemy.orm import Session

from service.api.devices.activation import active
from service.api.devices.schema import Device, DeviceChange, NewDevice, Source
from service.api.devices.sensor import Sensor, sensors_match
from service.api.devices.tracking_settings import Tracking
from service.database.engine import insert
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
    ReconstructionRow,
    RegistrationRow,
    RunRow,
    ToolCalibrationRow,
    ToolRow,
    WatchRow,
    WatchSampleRow,
)
from service.problems.errors import DeviceExists, DeviceInUse, DeviceRunning, UnknownDevice

_SOURCE: TypeAdapter[Source] = TypeAdapter(Source)
_SENSORS = TypeAdapter(list[Sensor])


def get_device(session: Session, device_id: str, *, lock: bool = False) -> DeviceRow:
    """Return a device, locked until the transaction's end on request; raises UnknownDevice."""
    row = session.get(DeviceRow, device_id, with_for_update=lock or None)
    if row is None:
        raise UnknownDevice(
            f'there is no device "{device_id}"; GET /api/v1/devices lists them', device=device_id
        )
    return row


def devices() -> Select[DeviceRow]:
    """Return all devices, by id."""
    return select(DeviceRow).order_by(DeviceRow.id)


def add_device(session: Session, request: NewDevice, sensors: list[Sensor]) -> DeviceRow:
    """Store a device; raises DeviceExists."""
    taken = DeviceExists(
        f'device "{request.id}" exists already; choose another id, or PATCH it',
        device=request.id,
    )
    if session.get(DeviceRow, request.id) is not None:
        raise taken
    now = datetime.now(UTC)
    row = DeviceRow(
        id=request.id,
        title=request.title,
        source=_SOURCE.dump_python(request.source, mode="json"),
        sensors=_SENSORS.dump_python(sensors, mode="json"),
        autostart=request.autostart,
        tracking=_stored(request.tracking),
        created_at=now,
        updated_at=now,
    )
    insert(session, row, taken)
    return row


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
    if "autostart" in given:
        row.autostart = change.autostart
    if "tracking" in given:
        row.tracking = _stored(_merged(tracking_of(row), change.tracking))
    if "source" in given and sensors is not None:
        described = _SENSORS.dump_python(sensors, mode="json")
        if described != row.sensors:
            _refuse_if_used(session, device_id, "changing its sensors would orphan them")
        if running and not sensors_match(sensors, sensors_of_row(row)):
            raise DeviceRunning(
                f'device "{device_id}" is running, and the new source has other sensors; stop the '
                "device first",
                device=device_id,
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
        DeviceInUse: calibrations, reconstructions, captures, runs, tools, registrations or
            holds belong to it, and ``cascade`` is not asked.
    """
    row = get_device(session, device_id, lock=True)
    if cascade:
        for table in (
            ReconstructionRow,
            RunRow,
            CaptureRow,
            ActivationRow,
            ActiveCalibrationRow,
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
        _refuse_if_used(
            session,
            device_id,
            "add ?cascade=true to delete them with it",
            captures=CaptureRow,
            runs=RunRow,
            tools=ToolRow,
            registrations=RegistrationRow,
            holds=HoldRow,
        )
    session.execute(delete(WatchRow).where(WatchRow.device_id == device_id))
    session.delete(row)
    session.flush()


def _refuse_if_used(
    session: Session,
    device_id: str,
    why: str,
    **others: type[CaptureRow | RunRow | ToolRow | RegistrationRow | HoldRow],
) -> None:
    """Raise DeviceInUse when calibrations, reconstructions or ``others`` belong to a device."""
    kinds = {"calibrations": CalibrationRow, "reconstructions": ReconstructionRow, **others}
    counts = {
        name: session.scalar(
            select(func.count()).select_from(table).where(table.device_id == device_id)
        )
        or 0
        for name, table in kinds.items()
    }
    if any(counts.values()):
        listed = [
            f"{count} {name if count != 1 else name.removesuffix('s')}"
            for name, count in counts.items()
            if count
        ]
        raise DeviceInUse(
            f'device "{device_id}" has {", ".join(listed)}; {why}', device=device_id, **counts
        )


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
    return Device(
        id=row.id,
        title=row.title,
        source=source_of(row),
        sensors=sensors_of_row(row),
        autostart=row.autostart,
        tracking=tracking_of(row),
        active_calibration_id=pointer.calibration_id if pointer else None,
        active_table_id=pointer.table_id if pointer else None,
        created_at=row.created_at,
        updated_at=row.updated_at,
    )
