"""Several gateways on one database: who lives, who does what, and where files are."""

import sqlalchemy as sa
from alembic import op

revision = "0022"
down_revision = "0021"
branch_labels = None
depends_on = None


def upgrade() -> None:
    moment = sa.DateTime(timezone=True)
    op.create_table(
        "gateways",
        sa.Column("id", sa.String(63), nullable=False),
        sa.Column("name", sa.String(200), nullable=False),
        sa.Column("host", sa.String(200), nullable=False),
        sa.Column("process_id", sa.Integer(), nullable=False),
        sa.Column("directory_id", sa.String(63), nullable=False),
        sa.Column("beat", sa.BigInteger(), nullable=False),
        sa.Column("started_at", moment, nullable=False),
        sa.Column("heartbeat_at", moment, nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_gateways"),
    )
    op.create_table(
        "leases",
        sa.Column("name", sa.String(80), nullable=False),
        sa.Column("gateway_id", sa.String(63), nullable=False),
        sa.PrimaryKeyConstraint("name", name="pk_leases"),
    )
    op.create_table(
        "device_changes",
        sa.Column("device_id", sa.String(63), nullable=False),
        sa.Column("wanted", sa.BigInteger(), nullable=False),
        sa.Column("followed", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("device_id", name="pk_device_changes"),
    )
    op.create_table(
        "stored_files",
        sa.Column("directory_id", sa.String(63), nullable=False),
        sa.Column("kind", sa.String(16), nullable=False),
        sa.Column("name", sa.String(200), nullable=False),
        sa.Column("changed_ns", sa.BigInteger(), nullable=False),
        sa.Column("document", sa.JSON(), nullable=False),
        sa.Column("gateway_id", sa.String(63), nullable=True),
        sa.Column("gateway_name", sa.String(200), nullable=False),
        sa.PrimaryKeyConstraint("directory_id", "kind", "name", name="pk_stored_files"),
    )
    op.create_table(
        "failed_logins",
        sa.Column("network", sa.String(64), nullable=False),
        sa.Column("spent", sa.Double(), nullable=False),
        sa.Column("at", moment, nullable=False),
        sa.PrimaryKeyConstraint("network", name="pk_failed_logins"),
    )
    op.add_column("runs", sa.Column("directory_id", sa.String(63), nullable=True))
    op.add_column("idempotency_keys", sa.Column("gateway_id", sa.String(63), nullable=True))


def downgrade() -> None:
    op.drop_column("idempotency_keys", "gateway_id")
    op.drop_column("runs", "directory_id")
    for name in ("failed_logins", "stored_files", "device_changes", "leases", "gateways"):
        op.drop_table(name)
