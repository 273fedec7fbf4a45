"""Rows that are never changed are not replaced either; nor are those of checks changed.

SQLite deletes the row that ``INSERT OR REPLACE`` replaces without asking the triggers of DELETE.
"""

from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None

_CHECKS = ("drift_checks", "quality_checks")
_BEFORE = ("calibrations", "correction_tables", "activations", "audit_log")  # guarded since 0004


def guards(dialect: str) -> list[str]:
    """Return the statements that make what refuses changes."""
    if dialect == "sqlite":
        return [
            *(refusal(table, "unchanged", "UPDATE", "changed") for table in _CHECKS),
            *(refusal(table, "not_replaced", "INSERT", "replaced") for table in _guarded()),
        ]
    return [
        f"CREATE TRIGGER {table}_unchanged BEFORE UPDATE ON {table} "
        "FOR EACH ROW EXECUTE FUNCTION lumiline_refuse('changed')"
        for table in _CHECKS
    ]


def _guarded() -> tuple[str, ...]:
    return (*_BEFORE, *_CHECKS)


def refusal(table: str, name: str, what: str, done: str) -> str:
    """Return the trigger by which SQLite refuses ``what``."""
    # A row may be replaced by its key, or by SQLite's own number of it.
    there = (
        f" WHEN EXISTS (SELECT 1 FROM {table} WHERE id = NEW.id OR rowid = NEW.rowid)"  # noqa: S608
        if what == "INSERT"
        else ""
    )
    return (
        f"CREATE TRIGGER {table}_{name} BEFORE {what} ON {table}{there} BEGIN "
        f"SELECT RAISE(ABORT, 'rows of {table} are never {done}'); END"
    )


def upgrade() -> None:
    bind = op.get_bind()
    for statement in guards(bind.dialect.name):
        bind.exec_driver_sql(statement)


def downgrade() -> None:
    bind = op.get_bind()
    sqlite = bind.dialect.name == "sqlite"
    for table in _CHECKS:
        bind.exec_driver_sql(f"DROP TRIGGER {table}_unchanged{'' if sqlite else f' ON {table}'}")
    if sqlite:
        for table in _guarded():
            bind.exec_driver_sql(f"DROP TRIGGER {table}_not_replaced")
