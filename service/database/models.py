"""Tables of the service as SQLAlchemy models; migrations/ holds the same as steps."""

from datetime import UTC, datetime
from typing import Any

from sqlalchemy import (
    JSON,
    BigInteger,
    DateTime,
    Dialect,
    Double,
    ForeignKey,
    ForeignKeyConstraint,
    Index,
    LargeBinary,
    MetaData,
    String,
    Text,
    TypeDecorator,
    UniqueConstraint,
)
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column


class UtcDateTime(TypeDecorator[datetime]):
    """A moment with its time zone, kept as UTC; SQLite would forget the zone."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:  # noqa: ARG002
        """Convert to UTC."""
        if value is not None and value.tzinfo is None:
            raise ValueError(f"{value!r} has no time zone")
        return value.astimezone(UTC) if value is not None else None

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:  # noqa: ARG002
        """Give the zone back."""
        if value is None:
            return None
        return value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC)


class Base(DeclarativeBase):
    """Base of the tables; constraints have names, so that migrations can drop them."""

    metadata = MetaData(
        naming_convention={
            "ix": "ix_%(table_name)s_%(column_0_N_name)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "ck": "ck_%(table_name)s_%(constraint_name)s",
            "fk": "fk_%(table_name)s_%(column_0_N_name)s_%(referred_table_name)s",
            "pk": "pk_%(table_name)s",
        }
    )


def _of_same_device(name: str, table: str | None = None) -> ForeignKeyConstraint:
    """Return the reference to a row of the same device, by default of the table ``names``."""
    table = table or f"{name}s"
    return ForeignKeyConstraint([f"{name}_id", "device_id"], [f"{table}.id", f"{table}.device_id"])


class _OfDevice:
    """Columns of what belongs to a device and is known by an id."""

    id: Mapped[str] = mapped_column(String(63), primary_key=True)
    device_id: Mapped[str] = mapped_column(ForeignKey("devices.id"))
    created_at: Mapped[datetime] = mapped_column(UtcDateTime)


class _NotedOfDevice(_OfDevice):
    note: Mapped[str] = mapped_column(Text)


class DeviceRow(Base):
    """A device: where its line scans come from, and its sensors."""

    __tablename__ = "devices"

    id: Mapped[str] = mapped_column(String(63), primary_key=True)
    title: Mapped[str] = mapped_column(String(200))
    source: Mapped[dict[str, Any]] = mapped_column(JSON)
    sensors: Mapped[list[dict[str, Any]]] = mapped_column(JSON)
    autostart: Mapped[bool]
    station: Mapped[str | None] = mapped_column(String(63))
    """The station that it belongs to; None: the server itself."""
    tracking: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))
    """How its markers are tracked; None: by default."""
    created_at: Mapped[datetime] = mapped_column(UtcDateTime)
    updated_at: Mapped[datetime] = mapped_column(UtcDateTime)


class CalibrationRow(_NotedOfDevice, Base):
    """A calibration; never changed but for the moment of its retirement."""

    __tablename__ = "calibrations"
    __table_args__ = (
        # What the composite foreign keys below refer to: a calibration together with its device.
        UniqueConstraint("id", "device_id"),
        Index(None, "device_id", "created_at"),
    )

    method: Mapped[str] = mapped_column(String(32))
    provenance: Mapped[str] = mapped_column(String(32))
    point_count: Mapped[int]
    content: Mapped[dict[str, Any]] = mapped_column(JSON)
    errors: Mapped[dict[str, Any]] = mapped_column(JSON)
    content_hash: Mapped[str] = mapped_column(String(64))
    retired_at: Mapped[datetime | None] = mapped_column(UtcDateTime)


class CorrectionTableRow(_NotedOfDevice, Base):
    """A correction table, never changed; ``data`` is the whole of it as an HDF5 file."""

    __tablename__ = "correction_tables"
    __table_args__ = (
        _of_same_device("calibration"),
        UniqueConstraint("id", "device_id"),
        Index(None, "device_id", "created_at"),
    )

    calibration_id: Mapped[str] = mapped_column(String(63))
    calibration_hash: Mapped[str] = mapped_column(String(64))
    content_hash: Mapped[str] = mapped_column(String(64))
    origin: Mapped[str] = mapped_column(String(16))
    content: Mapped[dict[str, Any]] = mapped_column(JSON)
    data: Mapped[bytes] = mapped_column(LargeBinary, deferred=True)


class ActiveCalibrationRow(Base):
    """The pointer: which of its calibrations a device uses now, and with which table."""

    __tablename__ = "active_calibrations"
    __table_args__ = (
        _of_same_device("calibration"),
        _of_same_device("table", "correction_tables"),
    )

    device_id: Mapped[str] = mapped_column(ForeignKey("devices.id"), primary_key=True)
    calibration_id: Mapped[str] = mapped_column(String(63))
    table_id: Mapped[str | None] = mapped_column(String(63))


class ActivationRow(Base):
    """One move of the pointer; rows are only ever added.

    ``restores_id`` is the earlier move that a roll-back went back to.
    """

    __tablename__ = "activations"
    __table_args__ = (
        _of_same_device("calibration"),
        _of_same_device("table", "correction_tables"),
    )

    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    device_id: Mapped[str] = mapped_column(ForeignKey("devices.id"), index=True)
    calibration_id: Mapped[str] = mapped_column(String(63))
    previous_calibration_id: Mapped[str | None] = mapped_column(String(63))
    table_id: Mapped[str | None] = mapped_column(String(63))
    previous_table_id: Mapped[str | None] = mapped_column(String(63))
    restores_id: Mapped[int | None]
    activated_at: Mapped[datetime] = mapped_column(UtcDateTime)
    actor: Mapped[str | None] = mapped_column(String(200))


class RadiometricCalibrationRow(_NotedOfDevice, Base):
    """A radiometric calibration of a device's sensors; never changed."""

    __tablename__ = "radiometric_calibrations"
    __table_args__ = (UniqueConstraint("id", "device_id"), Index(None, "device_id", "created_at"))

    origin: Mapped[str] = mapped_column(String(16))
    summary: Mapped[list[dict[str, Any]]] = mapped_column(JSON)
    """Figures of each sensor, for lists."""
    content: Mapped[dict[str, Any]] = mapped_column(JSON, deferred=True)
    content_hash: Mapped[str] = mapped_column(String(64))


class RadiometricActivationRow(Base):
    """One change of the radiometric calibration that a device uses; rows are only ever added.

    The newest row of a device is its pointer. ``radiometric_id`` None: it uses none from then on.
    """

    __tablename__ = "radiometric_activations"
    __table_args__ = (_of_same_device("radiometric", "radiometric_calibrations"),)

    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    device_id: Mapped[str] = mapped_column(ForeignKey("devices.id"), index=True)
    radiometric_id: Mapped[str | None] = mapped_column(String(63))
    previous_radiometric_id: Mapped[str | None] = mapped_column(String(63))
    activated_at: Mapped[datetime] = mapped_column(UtcDateTime)
    actor: Mapped[str | None] = mapped_column(String(200))


class RadiometricCaptureRow(_NotedOfDevice, Base):
    """Dark and flat captures of a device, of which a radiometric calibration is estimated.

    ``data`` holds the mean and the variance of each pixel in each capture, as a NumPy archive.
    """

    __tablename__ = "radiometric_captures"
    __table_args__ = (Index(None, "device_id", "created_at"),)

    sensors: Mapped[list[dict[str, Any]]] = mapped_column(JSON)
    settings: Mapped[dict[str, Any]] = mapped_column(JSON)
    captured: Mapped[list[dict[str, Any]]] = mapped_column(JSON)
    data: Mapped[bytes] = mapped_column(LargeBinary, deferred=True)
    updated_at: Mapped[datetime] = mapped_column(UtcDateTime)


class WaveCaptureRow(_NotedOfDevice, Base):
    """Poses of a wand or rigid body that was waved in front of a device, and what they cover.

    ``data`` holds the readings, as a NumPy archive.
    """

    __tablename__ = "wave_captures"
    __table_args__ = (Index(None, "device_id", "created_at"),)

    sensors: Mapped[list[dict[str, Any]]] = mapped_column(JSON)
    target: Mapped[dict[str, Any]] = mapped_column(JSON)
    markers: Mapped[list[int]] = mapped_column(JSON)
    settings: Mapped[dict[str, Any]] = mapped_column(JSON)
    progress: Mapped[dict[str, Any]] = mapped_column(JSON)
    ended: Mapped[str | None] = mapped_column(Text)
    data: Mapped[bytes] = mapped_column(LargeBinary, deferred=True)
    updated_at: Mapped[datetime] = mapped_column(UtcDateTime)


class ReconstructionRow(_OfDevice, Base):
    """Readings given by a client and the points computed from them."""

    __tablename__ = "reconstructions"
    __table_args__ = (
        _of_same_device("calibration"),
        _of_same_device("table", "correction_tables"),
        Index(None, "device_id", "created_at"),
    )

    calibration_id: Mapped[str] = mapped_column(String(63))
    table_id: Mapped[str | None] = mapped_column(String(63))
    points: Mapped[list[dict[str, Any]]] = mapped_column(JSON)
    estimates: Mapped[list[dict[str, Any]]] = mapped_column(JSON)
    point_count: Mapped[int]


class RunRow(_OfDevice, Base):
    """A calibration or a mapping that is computed beside the requests, and what became of it."""

    __tablename__ = "runs"
    __table_args__ = (Index(None, "device_id", "created_at"), Index(None, "state", "created_at"))

    kind: Mapped[str] = mapped_column(String(32))
    state: Mapped[str] = mapped_column(String(16))
    progress: Mapped[float] = mapped_column(Double)
    stage: Mapped[str] = mapped_column(String(200))
    request: Mapped[dict[str, Any]] = mapped_column(JSON, deferred=True)
    result_id: Mapped[str | None] = mapped_column(String(63))
    problem: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))
    poster: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))
    owner: Mapped[str | None] = mapped_column(String(200))
    started_at: Mapped[datetime | None] = mapped_column(UtcDateTime)
    finished_at: Mapped[datetime | None] = mapped_column(UtcDateTime)
    heartbeat_at: Mapped[datetime | None] = mapped_column(UtcDateTime)
    claim: Mapped[str | None] = mapped_column(String(80), unique=True, index=True)
    """What it is to store its result under; of an open run only."""
    directory_id: Mapped[str | None] = mapped_column(String(63))
    """The data directory that has the files it needs; None: it needs none."""


class DriftCheckRow(_NotedOfDevice, Base):
    """Drift check of a calibration by stationary markers; never changed."""

    __tablename__ = "drift_checks"
    __table_args__ = (
        _of_same_device("calibration"),
        Index(None, "device_id", "created_at"),
    )

    calibration_id: Mapped[str] = mapped_column(String(63))
    good: Mapped[bool]
    given: Mapped[dict[str, Any]] = mapped_column(JSON)
    points: Mapped[list[dict[str, Any]]] = mapped_column(JSON)
    result: Mapped[dict[str, Any]] = mapped_column(JSON)


class CaptureRow(_NotedOfDevice, Base):
    """Named target positions, and what a device's sensors read of a marker held at each."""

    __tablename__ = "captures"
    __table_args__ = (Index(None, "device_id", "created_at"),)

    sensors: Mapped[list[dict[str, Any]]] = mapped_column(JSON)
    settings: Mapped[dict[str, Any]] = mapped_column(JSON)
    targets: Mapped[list[dict[str, Any]]] = mapped_column(JSON)
    recording_id: Mapped[str | None] = mapped_column(String(200))
    captured: Mapped[dict[str, Any]] = mapped_column(JSON)
    updated_at: Mapped[datetime] = mapped_column(UtcDateTime)


class QualityCheckRow(_NotedOfDevice, Base):
    """A quality check and what it measured; never changed."""

    __tablename__ = "quality_checks"
    __table_args__ = (
        _of_same_device("calibration"),
        Index(None, "device_id", "created_at"),
    )

    calibration_id: Mapped[str] = mapped_column(String(63))
    table_id: Mapped[str | None] = mapped_column(String(63))
    kind: Mapped[str] = mapped_column(String(32))
    series: Mapped[str] = mapped_column(String(200))
    asked: Mapped[dict[str, Any]] = mapped_column(JSON)
    result: Mapped[dict[str, Any]] = mapped_column(JSON)
    passed: Mapped[bool | None]


class WatchRow(Base):
    """Settings of watching a device's drift."""

    __tablename__ = "watches"

    device_id: Mapped[str] = mapped_column(ForeignKey("devices.id"), primary_key=True)
    settings: Mapped[dict[str, Any]] = mapped_column(JSON)
    updated_at: Mapped[datetime] = mapped_column(UtcDateTime)


class WatchSampleRow(Base):
    """Statistics of a running device over one interval; never changed."""

    __tablename__ = "watch_samples"
    __table_args__ = (
        _of_same_device("calibration"),
        Index(None, "device_id", "at"),
    )

    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    device_id: Mapped[str] = mapped_column(ForeignKey("devices.id"))
    calibration_id: Mapped[str] = mapped_column(String(63))
    table_id: Mapped[str | None] = mapped_column(String(63))
    at: Mapped[datetime] = mapped_column(UtcDateTime)
    seconds: Mapped[float] = mapped_column(Double)
    points: Mapped[int]
    residual_sigma: Mapped[float | None] = mapped_column(Double)
    inconsistent: Mapped[int]
    reference_mm: Mapped[list[float] | None] = mapped_column(JSON(none_as_null=True))
    reference_scatter_mm: Mapped[float | None] = mapped_column(Double)
    temperature_c: Mapped[float | None] = mapped_column(Double)


class ToolRow(_NotedOfDevice, Base):
    """A rigid tool with markers, of one device.

    ``reference_id`` is the tool of the same device that its poses are given relative to; None:
    the tracker. ``tip`` says where the tip is and how that is known.
    """

    __tablename__ = "tools"
    __table_args__ = (UniqueConstraint("id", "device_id"), Index(None, "device_id"))

    title: Mapped[str] = mapped_column(String(200))
    markers_mm: Mapped[list[list[float]]] = mapped_column(JSON)
    strobe_markers: Mapped[list[int] | None] = mapped_column(JSON(none_as_null=True))
    tip: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))
    reference_id: Mapped[str | None] = mapped_column(String(63))
    limits: Mapped[dict[str, Any]] = mapped_column(JSON)
    origin: Mapped[dict[str, Any]] = mapped_column(JSON)
    updated_at: Mapped[datetime] = mapped_column(UtcDateTime)


class ToolCalibrationRow(_OfDevice, Base):
    """A pivot or spin calibration of a tool and what came of it; never changed."""

    __tablename__ = "tool_calibrations"
    __table_args__ = (
        _of_same_device("tool"),
        Index(None, "tool_id", "created_at"),
    )

    tool_id: Mapped[str] = mapped_column(String(63))
    kind: Mapped[str] = mapped_column(String(16))
    asked: Mapped[dict[str, Any]] = mapped_column(JSON)
    result: Mapped[dict[str, Any]] = mapped_column(JSON)
    applied: Mapped[bool]


class RegistrationRow(_NotedOfDevice, Base):
    """A named frame, and the transform into it from the tracker or from a tool; never changed."""

    __tablename__ = "registrations"
    __table_args__ = (Index(None, "device_id", "created_at"),)

    reference_id: Mapped[str | None] = mapped_column(String(63))
    asked: Mapped[dict[str, Any]] = mapped_column(JSON)
    result: Mapped[dict[str, Any]] = mapped_column(JSON)


class HoldRow(_NotedOfDevice, Base):
    """A beam hold of a device: what it watches, and how far that may move.

    ``tool_id`` is the tool that it watches, if so; ``reference`` how all was at set-up, None: that
    is not known.
    """

    __tablename__ = "holds"
    __table_args__ = (
        _of_same_device("tool"),
        Index(None, "device_id"),
    )

    tool_id: Mapped[str | None] = mapped_column(String(63))
    title: Mapped[str] = mapped_column(String(200))
    watch: Mapped[dict[str, Any]] = mapped_column(JSON)
    limits: Mapped[dict[str, Any]] = mapped_column(JSON)
    rules: Mapped[dict[str, Any]] = mapped_column(JSON)
    reference: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))
    updated_at: Mapped[datetime] = mapped_column(UtcDateTime)


class ApiKeyRow(Base):
    """A key that was given out; of its text only the digest is here."""

    __tablename__ = "api_keys"

    id: Mapped[str] = mapped_column(String(63), primary_key=True)
    name: Mapped[str] = mapped_column(String(200))
    digest: Mapped[str] = mapped_column(String(64))
    scopes: Mapped[list[str]] = mapped_column(JSON)
    created_by: Mapped[str] = mapped_column(String(200))
    created_at: Mapped[datetime] = mapped_column(UtcDateTime)
    expires_at: Mapped[datetime | None] = mapped_column(UtcDateTime)
    revoked_at: Mapped[datetime | None] = mapped_column(UtcDateTime)
    last_used_at: Mapped[datetime | None] = mapped_column(UtcDateTime)


class WebhookRow(Base):
    """A webhook; its secret is stored in clear, since signatures are made with it."""

    __tablename__ = "webhooks"

    id: Mapped[str] = mapped_column(String(63), primary_key=True)
    title: Mapped[str] = mapped_column(String(200))
    url: Mapped[str] = mapped_column(String(2000))
    event_types: Mapped[list[str]] = mapped_column(JSON)
    enabled: Mapped[bool]
    secret: Mapped[str] = mapped_column(String(100))
    created_at: Mapped[datetime] = mapped_column(UtcDateTime)
    updated_at: Mapped[datetime] = mapped_column(UtcDateTime)


class IdempotencyKeyRow(Base):
    """A request with an Idempotency-Key and its answer; without status it is carried out now."""

    __tablename__ = "idempotency_keys"
    __table_args__ = (Index(None, "created_at"),)

    principal: Mapped[str] = mapped_column(String(255), primary_key=True)
    key: Mapped[str] = mapped_column(String(255), primary_key=True)
    fingerprint: Mapped[str] = mapped_column(String(64))
    created_at: Mapped[datetime] = mapped_column(UtcDateTime)
    status: Mapped[int | None]
    headers: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))
    body: Mapped[bytes | None] = mapped_column(LargeBinary)
    """Compressed with zlib."""
    gateway_id: Mapped[str | None] = mapped_column(String(63))
    """The gateway that carries it out, or did; None: the only server of its database."""


class AuditRow(Base):
    """Audit entry: an act, done or refused; the database refuses to change or delete rows."""

    __tablename__ = "audit_log"
    __table_args__ = (
        Index(None, "object_kind", "object_id"),
        Index(None, "at"),
        {"sqlite_autoincrement": True},  # an id is never given twice
    )

    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    at: Mapped[datetime] = mapped_column(UtcDateTime)
    actor_kind: Mapped[str] = mapped_column(String(16))
    actor_id: Mapped[str] = mapped_column(String(200))
    actor_name: Mapped[str] = mapped_column(String(200))
    operation: Mapped[str] = mapped_column(String(64))
    outcome: Mapped[str] = mapped_column(String(16))
    object_kind: Mapped[str] = mapped_column(String(32))
    object_id: Mapped[str | None] = mapped_column(String(200))
    before: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))
    after: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))
    detail: Mapped[str | None] = mapped_column(Text)
    request_id: Mapped[str | None] = mapped_column(String(64))
    address: Mapped[str | None] = mapped_column(String(64))


TRANSIENT = "transient"
"""Key in a table's ``info``: its rows are of the servers that run now, and no backup has them."""


class GatewayRow(Base):
    """A server that lives: it raises ``beat`` each second, and others delete it when it does not.

    Of servers on PostgreSQL; SQLite has one at a time.
    """

    __tablename__ = "gateways"
    __table_args__ = ({"info": {TRANSIENT: True}},)

    id: Mapped[str] = mapped_column(String(63), primary_key=True)
    name: Mapped[str] = mapped_column(String(200))
    host: Mapped[str] = mapped_column(String(200))
    process_id: Mapped[int]
    directory_id: Mapped[str] = mapped_column(String(63))
    beat: Mapped[int] = mapped_column(BigInteger)
    started_at: Mapped[datetime] = mapped_column(UtcDateTime)
    heartbeat_at: Mapped[datetime] = mapped_column(UtcDateTime)


class LeaseRow(Base):
    """What one gateway does for all; another may take it when its gateway does not live."""

    __tablename__ = "leases"
    __table_args__ = ({"info": {TRANSIENT: True}},)

    name: Mapped[str] = mapped_column(String(80), primary_key=True)
    gateway_id: Mapped[str] = mapped_column(String(63))


class DeviceChangeRow(Base):
    """Number of the newest change of a device that a gateway without it made.

    ``followed`` is the newest that the gateway with the devices has put into effect.
    """

    __tablename__ = "device_changes"
    __table_args__ = ({"info": {TRANSIENT: True}},)

    device_id: Mapped[str] = mapped_column(String(63), primary_key=True)
    wanted: Mapped[int] = mapped_column(BigInteger)
    followed: Mapped[int] = mapped_column(BigInteger)


class StoredFileRow(Base):
    """A recording or export in the data directory of a gateway, as gateways of others list it.

    ``gateway_id`` is the gateway that writes it now; None: nobody does.
    """

    __tablename__ = "stored_files"
    __table_args__ = ({"info": {TRANSIENT: True}},)

    directory_id: Mapped[str] = mapped_column(String(63), primary_key=True)
    kind: Mapped[str] = mapped_column(String(16), primary_key=True)
    name: Mapped[str] = mapped_column(String(200), primary_key=True)
    changed_ns: Mapped[int] = mapped_column(BigInteger)
    document: Mapped[dict[str, Any]] = mapped_column(JSON)
    gateway_id: Mapped[str | None] = mapped_column(String(63))
    gateway_name: Mapped[str] = mapped_column(String(200))
    """Of the one that listed it last."""


class FailedLoginRow(Base):
    """Failed log-ins of an address at all gateways: a bucket that empties with time."""

    __tablename__ = "failed_logins"
    __table_args__ = ({"info": {TRANSIENT: True}},)

    network: Mapped[str] = mapped_column(String(64), primary_key=True)
    spent: Mapped[float] = mapped_column(Double)
    at: Mapped[datetime] = mapped_column(UtcDateTime)
