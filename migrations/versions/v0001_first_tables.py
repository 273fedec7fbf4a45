"""Devices, calibrations and their activations, reconstructions."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

_MOMENT = sa.DateTime(timezone=True)


def _of_device() -> sa.ForeignKeyConstraint:
    return sa.ForeignKeyConstraint(["device_id"], ["devices.id"])


def _calibration_of_device() -> sa.ForeignKeyConstraint:
    return sa.ForeignKeyConstraint(
        ["calibration_id", "device_id"], ["calibrations.id", "calibrations.device_id"]
    )


def upgrade() -> None:
    op.create_table(
        "devices",
        sa.Column("id", sa.String(63), primary_key=True),
        sa.Column("title", sa.String(200), nullable=False),
        sa.Column("source", sa.JSON(), nullable=False),
        sa.Column("sensors", sa.JSON(), nullable=False),
        sa.Column("autostart", sa.Boolean(), nullable=False),
        sa.Column("created_at", _MOMENT, nullable=False),
        sa.Column("updated_at", _MOMENT, nullable=False),
    )
    op.create_table(
        "calibrations",
        sa.Column("id", sa.String(63), primary_key=True),
        sa.Column("device_id", sa.String(63), nullable=False),
        sa.Column("method", sa.String(32), nullable=False),
        sa.Column("provenance", sa.String(32), nullable=False),
        sa.Column("note", sa.Text(), nullable=False),
        sa.Column("point_count", sa.Integer(), nullable=False),
        sa.Column("content", sa.JSON(), nullable=False),
        sa.Column("errors", sa.JSON(), nullable=False),
        sa.Column("content_hash", sa.String(64), nullable=False),
        sa.Column("created_at", _MOMENT, nullable=False),
        sa.Column("retired_at", _MOMENT, nullable=True),
        _of_device(),
        sa.UniqueConstraint("id", "device_id"),
    )
    op.create_index(
        op.f("ix_calibrations_device_id_created_at"), "calibrations", ["device_id", "created_at"]
    )
    op.create_table(
        "active_calibrations",
        sa.Column("device_id", sa.String(63), primary_key=True),
        sa.Column("calibration_id", sa.String(63), nullable=False),
        _of_device(),
        _calibration_of_device(),
    )
    op.create_table(
        "activations",
        sa.Column("id", sa.Integer(), primary_key=True, autoincrement=True),
        sa.Column("device_id", sa.String(63), nullable=False),
        sa.Column("calibration_id", sa.String(63), nullable=False),
        sa.Column("previous_calibration_id", sa.String(63), nullable=True),
        sa.Column("activated_at", _MOMENT, nullable=False),
        sa.Column("actor", sa.String(200), nullable=True),
        _of_device(),
        _calibration_of_device(),
    )
    op.create_index(op.f("ix_activations_device_id"), "activations", ["device_id"])
    op.create_table(
        "reconstructions",
        sa.Column("id", sa.String(63), primary_key=True),
        sa.Column("device_id", sa.String(63), nullable=False),
        sa.Column("calibration_id", sa.String(63), nullable=False),
        sa.Column("points", sa.JSON(), nullable=False),
        sa.Column("estimates", sa.JSON(), nullable=False),
        sa.Column("point_count", sa.Integer(), nullable=False),
        sa.Column("created_at", _MOMENT, nullable=False),
        _of_device(),
        _calibration_of_device(),
    )
    op.create_index(
        op.f("ix_reconstructions_device_id_created_at"),
        "reconstructions",
        ["device_id", "created_at"],
    )


def downgrade() -> None:
    for table in (
        "reconstructions",
        "activations",
        "active_calibrations",
        "calibrations",
        "devices",
    ):
        op.drop_table(table)
