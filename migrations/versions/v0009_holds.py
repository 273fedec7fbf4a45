"""Beam holds."""

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None

_MOMENT = sa.DateTime(timezone=True)


def upgrade() -> None:
    op.create_table(
        "holds",
        sa.Column("id", sa.String(63), primary_key=True),
        sa.Column("device_id", sa.String(63), nullable=False),
        sa.Column("tool_id", sa.String(63), nullable=True),
        sa.Column("title", sa.String(200), nullable=False),
        sa.Column("watch", sa.JSON(), nullable=False),
        sa.Column("limits", sa.JSON(), nullable=False),
        sa.Column("rules", sa.JSON(), nullable=False),
        sa.Column("reference", sa.JSON(), nullable=True),
        sa.Column("note", sa.Text(), nullable=False),
        sa.Column("created_at", _MOMENT, nullable=False),
        sa.Column("updated_at", _MOMENT, nullable=False),
        sa.ForeignKeyConstraint(["device_id"], ["devices.id"]),
        sa.ForeignKeyConstraint(["tool_id", "device_id"], ["tools.id", "tools.device_id"]),
    )
    op.create_index(op.f("ix_holds_device_id"), "holds", ["device_id"])


def downgrade() -> None:
    op.drop_table("holds")
