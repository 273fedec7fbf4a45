"""Tables of the service as SQLAlchemy models; migrations/ holds the same as steps."""

from datetime import UTC, datetime
from typing import Any

from sqlalchemy import (
    JSON,
    DateTime,
    Dialect,
    ForeignKey,
    ForeignKeyConstraint,
    Index,
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


class DeviceRow(Base):
    """A device: where its line scans come from, and its sensors."""

    __tablename__ = "devices"

    id: Mapped[str] = mapped_column(String(63), primary_key=True)
    title: Mapped[str] = mapped_column(String(200))
    source: Mapped[dict[str, Any]] = mapped_column(JSON)
    sensors: Mapped[list[dict[str, Any]]] = mapped_column(JSON)
    autostart: Mapped[bool]
    created_at: Mapped[datetime] = mapped_column(UtcDateTime)
    updated_at: Mapped[datetime] = mapped_column(UtcDateTime)


class CalibrationRow(Base):
    """A calibration; never changed but for the moment of its retirement."""

    __tablename__ = "calibrations"
    __table_args__ = (
        # What the composite foreign keys below refer to: a calibration together with its device.
        UniqueConstraint("id", "device_id"),
        Index(None, "device_id", "created_at"),
    )

    id: Mapped[str] = mapped_column(String(63), primary_key=True)
    device_id: Mapped[str] = mapped_column(ForeignKey("devices.id"))
    method: Mapped[str] = mapped_column(String(32))
    provenance: Mapped[str] = mapped_column(String(32))
    note: Mapped[str] = mapped_column(Text)
    point_count: Mapped[int]
    content: Mapped[dict[str, Any]] = mapped_column(JSON)
    errors: Mapped[dict[str, Any]] = mapped_column(JSON)
    content_hash: Mapped[str] = mapped_column(String(64))
    created_at: Mapped[datetime] = mapped_column(UtcDateTime)
    retired_at: Mapped[datetime | None] = mapped_column(UtcDateTime)


class ActiveCalibrationRow(Base):
    """The pointer: which of its calibrations a device uses now."""

    __tablename__ = "active_calibrations"
    __table_args__ = (
        ForeignKeyConstraint(
            ["calibration_id", "device_id"], ["calibrations.id", "calibrations.device_id"]
        ),
    )

    device_id: Mapped[str] = mapped_column(ForeignKey("devices.id"), primary_key=True)
    calibration_id: Mapped[str] = mapped_column(String(63))


class ActivationRow(Base):
    """One move of the pointer; rows are only ever added."""

    __tablename__ = "activations"
    __table_args__ = (
        ForeignKeyConstraint(
            ["calibration_id", "device_id"], ["calibrations.id", "calibrations.device_id"]
        ),
    )

    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    device_id: Mapped[str] = mapped_column(ForeignKey("devices.id"), index=True)
    calibration_id: Mapped[str] = mapped_column(String(63))
    previous_calibration_id: Mapped[str | None] = mapped_column(String(63))
    activated_at: Mapped[datetime] = mapped_column(UtcDateTime)
    actor: Mapped[str | None] = mapped_column(String(200))


class ReconstructionRow(Base):
    """Readings given by a client and the points computed from them."""

    __tablename__ = "reconstructions"
    __table_args__ = (
        ForeignKeyConstraint(
            ["calibration_id", "device_id"], ["calibrations.id", "calibrations.device_id"]
        ),
        Index(None, "device_id", "created_at"),
    )

    id: Mapped[str] = mapped_column(String(63), primary_key=True)
    device_id: Mapped[str] = mapped_column(ForeignKey("devices.id"))
    calibration_id: Mapped[str] = mapped_column(String(63))
    points: Mapped[list[dict[str, Any]]] = mapped_column(JSON)
    estimates: Mapped[list[dict[str, Any]]] = mapped_column(JSON)
    point_count: Mapped[int]
    created_at: Mapped[datetime] = mapped_column(UtcDateTime)
