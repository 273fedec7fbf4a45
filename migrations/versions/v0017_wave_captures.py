"""Wave captures: poses of a wand or rigid body waved in front of a device."""

import sqlalchemy as sa
from alembic import op

revision = "0017"
down_revision = "0016"
branch_labels = None
depends_on = None

_TABLE = "wave_captures"


def upgrade() -> None:
    op.create_table(
        _TABLE,
        sa.Column("id", sa.String(63), primary_key=True),
        sa.Column("device_id", sa.String(63), nullable=False),
        sa.Column("sensors", sa.JSON(), nullable=False),
        sa.Column("target", sa.JSON(), nullable=False),
        sa.Column("markers", sa.JSON(), nullable=False),
        sa.Column("settings", sa.JSON(), nullable=False),
        sa.Column("progress", sa.JSON(), nullable=False),
        sa.Column("ended", sa.Text(), nullable=True),
        sa.Column("data", sa.LargeBinary(), nullable=False),
        sa.Column("note", sa.Text(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("updated_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["device_id"], ["devices.id"]),
    )
    op.create_index(
        op.f("ix_wave_captures_device_id_created_at"), _TABLE, ["device_id", "created_at"]
    )


def downgrade() -> None:
    op.drop_table(_TABLE)
