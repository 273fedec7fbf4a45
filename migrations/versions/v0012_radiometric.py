"""Radiometric calibrations of sensors, their captures, and which one a device uses."""

import sqlalchemy as sa
from alembic import op

from migrations.versions.v0006_guards import refusal

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None

_MOMENT = sa.DateTime(timezone=True)
_IMMUTABLE = ("radiometric_calibrations", "radiometric_activations")


def guards(dialect: str) -> list[str]:
    """Return the statements that make what refuses changes of what was measured."""
    if dialect == "sqlite":
        return [
            refusal(table, name, what, done)
            for table in _IMMUTABLE
            for name, what, done in (
                ("unchanged", "UPDATE", "changed"),
                ("not_replaced", "INSERT", "replaced"),
            )
        ]
    return [
        f"CREATE TRIGGER {table}_unchanged BEFORE UPDATE ON {table} "
        "FOR EACH ROW EXECUTE FUNCTION lumiline_refuse('changed')"
        for table in _IMMUTABLE
    ]


def upgrade() -> None:
    op.create_table(
        "radiometric_calibrations",
        sa.Column("id", sa.String(63), primary_key=True),
        sa.Column("device_id", sa.String(63), nullable=False),
        sa.Column("origin", sa.String(16), nullable=False),
        sa.Column("summary", sa.JSON(), nullable=False),
        sa.Column("content", sa.JSON(), nullable=False),
        sa.Column("content_hash", sa.String(64), nullable=False),
        sa.Column("note", sa.Text(), nullable=False),
        sa.Column("created_at", _MOMENT, nullable=False),
        sa.ForeignKeyConstraint(["device_id"], ["devices.id"]),
        sa.UniqueConstraint("id", "device_id"),
    )
    op.create_index(
        op.f("ix_radiometric_calibrations_device_id_created_at"),
        "radiometric_calibrations",
        ["device_id", "created_at"],
    )
    op.create_table(
        "radiometric_activations",
        sa.Column("id", sa.Integer(), primary_key=True, autoincrement=True),
        sa.Column("device_id", sa.String(63), nullable=False),
        sa.Column("radiometric_id", sa.String(63), nullable=True),
        sa.Column("previous_radiometric_id", sa.String(63), nullable=True),
        sa.Column("activated_at", _MOMENT, nullable=False),
        sa.Column("actor", sa.String(200), nullable=True),
        sa.ForeignKeyConstraint(["device_id"], ["devices.id"]),
        sa.ForeignKeyConstraint(
            ["radiometric_id", "device_id"],
            ["radiometric_calibrations.id", "radiometric_calibrations.device_id"],
        ),
    )
    op.create_index(
        op.f("ix_radiometric_activations_device_id"), "radiometric_activations", ["device_id"]
    )
    op.create_table(
        "radiometric_captures",
        sa.Column("id", sa.String(63), primary_key=True),
        sa.Column("device_id", sa.String(63), nullable=False),
        sa.Column("sensors", sa.JSON(), nullable=False),
        sa.Column("settings", sa.JSON(), nullable=False),
        sa.Column("captured", sa.JSON(), nullable=False),
        sa.Column("data", sa.LargeBinary(), nullable=False),
        sa.Column("note", sa.Text(), nullable=False),
        sa.Column("created_at", _MOMENT, nullable=False),
        sa.Column("updated_at", _MOMENT, nullable=False),
        sa.ForeignKeyConstraint(["device_id"], ["devices.id"]),
    )
    op.create_index(
        op.f("ix_radiometric_captures_device_id_created_at"),
        "radiometric_captures",
        ["device_id", "created_at"],
    )
    bind = op.get_bind()
    for statement in guards(bind.dialect.name):
        bind.exec_driver_sql(statement)


def downgrade() -> None:
    # The triggers go with their tables.
    for table in ("radiometric_captures", "radiometric_activations", "radiometric_calibrations"):
        op.drop_table(table)
