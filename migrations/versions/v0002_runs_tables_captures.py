"""Runs, correction tables and captures; the pointer and its history name a table."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

_MOMENT = sa.DateTime(timezone=True)


def _of_device() -> sa.ForeignKeyConstraint:
    return sa.ForeignKeyConstraint(["device_id"], ["devices.id"])


def upgrade() -> None:
    op.create_table(
        "correction_tables",
        sa.Column("id", sa.String(63), primary_key=True),
        sa.Column("device_id", sa.String(63), nullable=False),
        sa.Column("calibration_id", sa.String(63), nullable=False),
        sa.Column("calibration_hash", sa.String(64), nullable=False),
        sa.Column("content_hash", sa.String(64), nullable=False),
        sa.Column("origin", sa.String(16), nullable=False),
        sa.Column("note", sa.Text(), nullable=False),
        sa.Column("content", sa.JSON(), nullable=False),
        sa.Column("data", sa.LargeBinary(), nullable=False),
        sa.Column("created_at", _MOMENT, nullable=False),
        _of_device(),
        sa.ForeignKeyConstraint(
            ["calibration_id", "device_id"], ["calibrations.id", "calibrations.device_id"]
        ),
        sa.UniqueConstraint("id", "device_id"),
    )
    op.create_index(
        op.f("ix_correction_tables_device_id_created_at"),
        "correction_tables",
        ["device_id", "created_at"],
    )
    for table, columns in (
        ("active_calibrations", (sa.Column("table_id", sa.String(63), nullable=True),)),
        ("reconstructions", (sa.Column("table_id", sa.String(63), nullable=True),)),
        (
            "activations",
            (
                sa.Column("table_id", sa.String(63), nullable=True),
                sa.Column("previous_table_id", sa.String(63), nullable=True),
                sa.Column("restores_id", sa.Integer(), nullable=True),
            ),
        ),
    ):
        with op.batch_alter_table(table) as batch:
            for column in columns:
                batch.add_column(column)
            batch.create_foreign_key(
                op.f(f"fk_{table}_table_id_device_id_correction_tables"),
                "correction_tables",
                ["table_id", "device_id"],
                ["id", "device_id"],
            )
    op.create_table(
        "runs",
        sa.Column("id", sa.String(63), primary_key=True),
        sa.Column("kind", sa.String(32), nullable=False),
        sa.Column("device_id", sa.String(63), nullable=False),
        sa.Column("state", sa.String(16), nullable=False),
        sa.Column("progress", sa.Double(), nullable=False),
        sa.Column("stage", sa.String(200), nullable=False),
        sa.Column("request", sa.JSON(), nullable=False),
        sa.Column("result_id", sa.String(63), nullable=True),
        sa.Column("problem", sa.JSON(), nullable=True),
        sa.Column("owner", sa.String(200), nullable=True),
        sa.Column("created_at", _MOMENT, nullable=False),
        sa.Column("started_at", _MOMENT, nullable=True),
        sa.Column("finished_at", _MOMENT, nullable=True),
        sa.Column("heartbeat_at", _MOMENT, nullable=True),
        _of_device(),
    )
    op.create_index(op.f("ix_runs_device_id_created_at"), "runs", ["device_id", "created_at"])
    op.create_index(op.f("ix_runs_state_created_at"), "runs", ["state", "created_at"])
    op.create_table(
        "captures",
        sa.Column("id", sa.String(63), primary_key=True),
        sa.Column("device_id", sa.String(63), nullable=False),
        sa.Column("sensors", sa.JSON(), nullable=False),
        sa.Column("settings", sa.JSON(), nullable=False),
        sa.Column("targets", sa.JSON(), nullable=False),
        sa.Column("captured", sa.JSON(), nullable=False),
        sa.Column("note", sa.Text(), nullable=False),
        sa.Column("created_at", _MOMENT, nullable=False),
        sa.Column("updated_at", _MOMENT, nullable=False),
        _of_device(),
    )
    op.create_index(
        op.f("ix_captures_device_id_created_at"), "captures", ["device_id", "created_at"]
    )


def downgrade() -> None:
    op.drop_table("captures")
    op.drop_table("runs")
    for table, columns in (
        ("activations", ("restores_id", "previous_table_id", "table_id")),
        ("reconstructions", ("table_id",)),
        ("active_calibrations", ("table_id",)),
    ):
        with op.batch_alter_table(table) as batch:
            batch.drop_constraint(
                op.f(f"fk_{table}_table_id_device_id_correction_tables"), type_="foreignkey"
            )
            for column in columns:
                batch.drop_column(column)
    op.drop_table("correction_tables")
