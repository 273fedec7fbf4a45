"""Capture sessions whose targets were captured from a recording."""

import sqlalchemy as sa
from alembic import op

revision = "0019"
down_revision = "0018"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("captures", sa.Column("recording_id", sa.String(200), nullable=True))


def downgrade() -> None:
    op.drop_column("captures", "recording_id")
