"""API keys and the audit log; what is immutable is refused by the database, too.

On SQLite a table that is made anew (``batch_alter_table``) loses its triggers: a later revision
that does so to one of these has to create them again.
"""

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None

_MOMENT = sa.DateTime(timezone=True)

# Tables of which rows are never changed, with the columns that are not; none named: all.
_UNCHANGED: dict[str, tuple[str, ...]] = {
    "calibrations": (
        "id", "device_id", "method", "provenance", "note", "point_count", "content", "errors",
        "content_hash", "created_at",
    ),
    "correction_tables": (),
    "activations": (),
    "audit_log": (),
}  # fmt: skip
_KEPT = "audit_log"


def upgrade() -> None:
    op.create_table(
        "api_keys",
        sa.Column("id", sa.String(63), primary_key=True),
        sa.Column("name", sa.String(200), nullable=False),
        sa.Column("digest", sa.String(64), nullable=False),
        sa.Column("scopes", sa.JSON(), nullable=False),
        sa.Column("created_by", sa.String(200), nullable=False),
        sa.Column("created_at", _MOMENT, nullable=False),
        sa.Column("expires_at", _MOMENT, nullable=True),
        sa.Column("revoked_at", _MOMENT, nullable=True),
        sa.Column("last_used_at", _MOMENT, nullable=True),
    )
    op.create_table(
        "audit_log",
        sa.Column("id", sa.Integer(), primary_key=True, autoincrement=True),
        sa.Column("at", _MOMENT, nullable=False),
        sa.Column("actor_kind", sa.String(16), nullable=False),
        sa.Column("actor_id", sa.String(200), nullable=False),
        sa.Column("actor_name", sa.String(200), nullable=False),
        sa.Column("operation", sa.String(64), nullable=False),
        sa.Column("outcome", sa.String(16), nullable=False),
        sa.Column("object_kind", sa.String(32), nullable=False),
        sa.Column("object_id", sa.String(200), nullable=True),
        sa.Column("before", sa.JSON(), nullable=True),
        sa.Column("after", sa.JSON(), nullable=True),
        sa.Column("detail", sa.Text(), nullable=True),
        sa.Column("request_id", sa.String(64), nullable=True),
        sa.Column("address", sa.String(64), nullable=True),
        sqlite_autoincrement=True,
    )
    op.create_index(
        op.f("ix_audit_log_object_kind_object_id"), "audit_log", ["object_kind", "object_id"]
    )
    op.create_index(op.f("ix_audit_log_at"), "audit_log", ["at"])
    for statement in guards(op.get_bind().dialect.name):
        op.get_bind().exec_driver_sql(statement)


def guards(dialect: str) -> list[str]:
    """Return the statements that make what refuses changes, functions first."""
    return _sqlite_triggers() if dialect == "sqlite" else _postgresql_triggers()


def _of(columns: tuple[str, ...]) -> str:
    return f" OF {', '.join(columns)}" if columns else ""


def _sqlite_triggers() -> list[str]:
    unchanged = [
        f"CREATE TRIGGER {table}_unchanged BEFORE UPDATE{_of(columns)} ON {table} BEGIN "
        f"SELECT RAISE(ABORT, 'rows of {table} are never changed'); END"
        for table, columns in _UNCHANGED.items()
    ]
    kept = (
        f"CREATE TRIGGER {_KEPT}_kept BEFORE DELETE ON {_KEPT} BEGIN "
        f"SELECT RAISE(ABORT, 'rows of {_KEPT} are never deleted'); END"
    )
    retired = (
        "CREATE TRIGGER calibrations_retired BEFORE UPDATE OF retired_at ON calibrations "
        "WHEN OLD.retired_at IS NOT NULL AND OLD.retired_at IS NOT NEW.retired_at BEGIN "
        "SELECT RAISE(ABORT, 'a calibration is retired once, for good'); END"
    )
    return [*unchanged, kept, retired]


def _postgresql_triggers() -> list[str]:
    refuse = (  # its argument: what is done to the rows
        "CREATE OR REPLACE FUNCTION lumiline_refuse() RETURNS trigger LANGUAGE plpgsql AS $$ "
        "BEGIN RAISE EXCEPTION 'rows of %% are never %%', TG_TABLE_NAME, TG_ARGV[0] "
        "USING ERRCODE = 'integrity_constraint_violation'; END $$"
    )
    once = (
        "CREATE OR REPLACE FUNCTION lumiline_retired() RETURNS trigger LANGUAGE plpgsql AS $$ "
        "BEGIN RAISE EXCEPTION 'a calibration is retired once, for good' "
        "USING ERRCODE = 'integrity_constraint_violation'; END $$"
    )
    unchanged = [
        f"CREATE TRIGGER {table}_unchanged BEFORE UPDATE{_of(columns)} ON {table} "
        "FOR EACH ROW EXECUTE FUNCTION lumiline_refuse('changed')"
        for table, columns in _UNCHANGED.items()
    ]
    kept = (
        f"CREATE TRIGGER {_KEPT}_kept BEFORE DELETE ON {_KEPT} "
        "FOR EACH ROW EXECUTE FUNCTION lumiline_refuse('deleted')"
    )
    truncated = (
        f"CREATE TRIGGER {_KEPT}_truncated BEFORE TRUNCATE ON {_KEPT} "
        "FOR EACH STATEMENT EXECUTE FUNCTION lumiline_refuse('deleted')"
    )
    retired = (
        "CREATE TRIGGER calibrations_retired BEFORE UPDATE OF retired_at ON calibrations "
        "FOR EACH ROW WHEN (OLD.retired_at IS NOT NULL "
        "AND OLD.retired_at IS DISTINCT FROM NEW.retired_at) EXECUTE FUNCTION lumiline_retired()"
    )
    return [refuse, once, *unchanged, kept, truncated, retired]


def downgrade() -> None:
    bind = op.get_bind()
    on = bind.dialect.name != "sqlite"
    for table in ("calibrations", "correction_tables", "activations"):
        suffix = f" ON {table}" if on else ""
        bind.exec_driver_sql(f"DROP TRIGGER {table}_unchanged{suffix}")
    bind.exec_driver_sql(f"DROP TRIGGER calibrations_retired{' ON calibrations' if on else ''}")
    op.drop_table("audit_log")  # and its triggers
    op.drop_table("api_keys")
    if on:
        bind.exec_driver_sql("DROP FUNCTION lumiline_refuse()")
        bind.exec_driver_sql("DROP FUNCTION lumiline_retired()")
