"""Tools, their calibrations, registrations, and how devices are tracked."""

import sqlalchemy as sa
from alembic import op

from migrations.versions.v0006_guards import refusal

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None

_MOMENT = sa.DateTime(timezone=True)
_IMMUTABLE = ("registrations", "tool_calibrations")


def _of_device() -> sa.ForeignKeyConstraint:
    return sa.ForeignKeyConstraint(["device_id"], ["devices.id"])


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
    op.add_column("devices", sa.Column("tracking", sa.JSON(), nullable=True))
    op.create_table(
        "tools",
        sa.Column("id", sa.String(63), primary_key=True),
        sa.Column("device_id", sa.String(63), nullable=False),
        sa.Column("title", sa.String(200), nullable=False),
        sa.Column("markers_mm", sa.JSON(), nullable=False),
        sa.Column("strobe_markers", sa.JSON(), nullable=True),
        sa.Column("tip", sa.JSON(), nullable=True),
        sa.Column("reference_id", sa.String(63), nullable=True),
        sa.Column("limits", sa.JSON(), nullable=False),
        sa.Column("origin", sa.JSON(), nullable=False),
        sa.Column("note", sa.Text(), nullable=False),
        sa.Column("created_at", _MOMENT, nullable=False),
        sa.Column("updated_at", _MOMENT, nullable=False),
        sa.UniqueConstraint("id", "device_id"),
        _of_device(),
    )
    op.create_index(op.f("ix_tools_device_id"), "tools", ["device_id"])
    op.create_table(
        "tool_calibrations",
        sa.Column("id", sa.String(63), primary_key=True),
        sa.Column("device_id", sa.String(63), nullable=False),
        sa.Column("tool_id", sa.String(63), nullable=False),
        sa.Column("kind", sa.String(16), nullable=False),
        sa.Column("asked", sa.JSON(), nullable=False),
        sa.Column("result", sa.JSON(), nullable=False),
        sa.Column("applied", sa.Boolean(), nullable=False),
        sa.Column("created_at", _MOMENT, nullable=False),
        _of_device(),
        sa.ForeignKeyConstraint(["tool_id", "device_id"], ["tools.id", "tools.device_id"]),
    )
    op.create_index(
        op.f("ix_tool_calibrations_tool_id_created_at"),
        "tool_calibrations",
        ["tool_id", "created_at"],
    )
    op.create_table(
        "registrations",
        sa.Column("id", sa.String(63), primary_key=True),
        sa.Column("device_id", sa.String(63), nullable=False),
        sa.Column("reference_id", sa.String(63), nullable=True),
        sa.Column("asked", sa.JSON(), nullable=False),
        sa.Column("result", sa.JSON(), nullable=False),
        sa.Column("note", sa.Text(), nullable=False),
        sa.Column("created_at", _MOMENT, nullable=False),
        _of_device(),
    )
    op.create_index(
        op.f("ix_registrations_device_id_created_at"),
        "registrations",
        ["device_id", "created_at"],
    )
    bind = op.get_bind()
    for statement in guards(bind.dialect.name):
        bind.exec_driver_sql(statement)


def downgrade() -> None:
    # The triggers go with their tables.
    for table in ("registrations", "tool_calibrations", "tools"):
        op.drop_table(table)
    op.drop_column("devices", "tracking")
