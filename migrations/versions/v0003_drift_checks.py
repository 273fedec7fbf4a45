"""Drift checks; what an open run is to store its result under is claimed by one run at most."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "drift_checks",
        sa.Column("id", sa.String(63), primary_key=True),
        sa.Column("device_id", sa.String(63), nullable=False),
        sa.Column("calibration_id", sa.String(63), nullable=False),
        sa.Column("good", sa.Boolean(), nullable=False),
        sa.Column("given", sa.JSON(), nullable=False),
        sa.Column("points", sa.JSON(), nullable=False),
        sa.Column("result", sa.JSON(), nullable=False),
        sa.Column("note", sa.Text(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["device_id"], ["devices.id"]),
        sa.ForeignKeyConstraint(
            ["calibration_id", "device_id"], ["calibrations.id", "calibrations.device_id"]
        ),
    )
    op.create_index(
        op.f("ix_drift_checks_device_id_created_at"), "drift_checks", ["device_id", "created_at"]
    )
    op.add_column("runs", sa.Column("claim", sa.String(80), nullable=True))
    _claim_of_open_runs()
    op.create_index(op.f("ix_runs_claim"), "runs", ["claim"], unique=True)


def _claim_of_open_runs() -> None:
    runs = sa.table(
        "runs",
        sa.column("id", sa.String),
        sa.column("kind", sa.String),
        sa.column("state", sa.String),
        sa.column("request", sa.JSON),
        sa.column("created_at", sa.DateTime(timezone=True)),
        sa.column("claim", sa.String),
    )
    connection = op.get_bind()
    found = connection.execute(
        sa.select(runs.c.id, runs.c.kind, runs.c.request)
        .where(runs.c.state.in_(("queued", "running")))
        .order_by(runs.c.created_at, runs.c.id)
    ).all()
    taken: set[str] = set()
    for run_id, kind, request in found:
        result_id = request.get("result_id")
        claim = f"{'table' if kind == 'mapping' else 'calibration'}/{result_id}"
        # Of two that were accepted for one id the first keeps it, as the second would fail.
        if result_id is not None and claim not in taken:
            taken.add(claim)
            connection.execute(sa.update(runs).where(runs.c.id == run_id).values(claim=claim))


def downgrade() -> None:
    op.drop_index(op.f("ix_runs_claim"), "runs")
    op.drop_column("runs", "claim")
    op.drop_table("drift_checks")
