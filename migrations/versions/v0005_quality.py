"""Quality checks, watches of devices and what they saw."""

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
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
        "quality_checks",
        sa.Column("id", sa.String(63), primary_key=True),
        sa.Column("device_id", sa.String(63), nullable=False),
        sa.Column("calibration_id", sa.String(63), nullable=False),
        sa.Column("table_id", sa.String(63), nullable=True),
        sa.Column("kind", sa.String(32), nullable=False),
        sa.Column("series", sa.String(200), nullable=False),
        sa.Column("asked", sa.JSON(), nullable=False),
        sa.Column("result", sa.JSON(), nullable=False),
        sa.Column("passed", sa.Boolean(), nullable=True),
        sa.Column("note", sa.Text(), nullable=False),
        sa.Column("created_at", _MOMENT, nullable=False),
        _of_device(),
        _calibration_of_device(),
    )
    op.create_index(
        op.f("ix_quality_checks_device_id_created_at"),
        "quality_checks",
        ["device_id", "created_at"],
    )
    op.create_table(
        "watches",
        sa.Column("device_id", sa.String(63), primary_key=True),
        sa.Column("settings", sa.JSON(), nullable=False),
        sa.Column("updated_at", _MOMENT, nullable=False),
        _of_device(),
    )
    op.create_table(
        "watch_samples",
        sa.Column("id", sa.Integer(), primary_key=True, autoincrement=True),
        sa.Column("device_id", sa.String(63), nullable=False),
        sa.Column("calibration_id", sa.String(63), nullable=False),
        sa.Column("table_id", sa.String(63), nullable=True),
        sa.Column("at", _MOMENT, nullable=False),
        sa.Column("seconds", sa.Double(), nullable=False),
        sa.Column("points", sa.Integer(), nullable=False),
        sa.Column("residual_sigma", sa.Double(), nullable=True),
        sa.Column("inconsistent", sa.Integer(), nullable=False),
        sa.Column("reference_mm", sa.JSON(), nullable=True),
        sa.Column("reference_scatter_mm", sa.Double(), nullable=True),
        sa.Column("temperature_c", sa.Double(), nullable=True),
        _of_device(),
        _calibration_of_device(),
    )
    op.create_index(op.f("ix_watch_samples_device_id_at"), "watch_samples", ["device_id", "at"])


def downgrade() -> None:
    for table in ("watch_samples", "watches", "quality_checks"):
        op.drop_table(table)
