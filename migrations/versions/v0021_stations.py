"""Devices say which station they belong to; without one they are the server's own, as before."""

import sqlalchemy as sa
from alembic import op

revision = "0021"
down_revision = "0020"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("devices", sa.Column("station", sa.String(63), nullable=True))


def downgrade() -> None:
    op.drop_column("devices", "station")
