"""Revisions of a database's schema, and its migration to the newest."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection
from sqlalchemy.orm import Session

import migrations
from service.database.engine import Database


def alembic_config(connection: Connection) -> Config:
    """Return Alembic's configuration for a connection; its revisions are in ``migrations``."""
    config = Config()
    config.set_main_option("script_location", str(Path(migrations.__file__).parent))
    config.set_main_option("path_separator", "os")
    config.attributes["connection"] = connection
    return config


@cache
def newest_revision() -> str:
    """Return the newest revision that this version knows; cached, as reading all takes long."""
    found = ScriptDirectory(migrations.__path__[0]).get_current_head()
    assert found is not None
    return found


def revision_of(connection: Connection) -> str | None:
    """Return the revision of a database, None of one that holds nothing of ours."""
    return MigrationContext.configure(connection).get_current_revision()


def lock_schema(connection: Connection) -> None:
    """Let other servers that start wait, until the transaction's end (SQLite: they do anyway)."""
    if connection.dialect.name == "postgresql":
        connection.exec_driver_sql("SELECT pg_advisory_xact_lock(5421078)")


def migrate(
    database: Database, revision: str = "head", fill: Callable[[Session], None] | None = None
) -> bool:
    """Upgrade the database to ``revision`` and fill it when it is new, in one transaction.

    Whether a database is new is seen from its revision. Committed together with the first
    content, that says that both are there: a start that was cut short leaves neither, and what
    a user deleted does not come back.

    Args:
        database: the database.
        revision: the revision to reach.
        fill: stores the first content of a new database.

    Returns:
        Whether it was new.
    """
    with database.engine.execution_options(lumiline_write=True).begin() as connection:
        lock_schema(connection)
        current = revision_of(connection)
        new = current is None
        # Alembic reads all revisions even where there is nothing to do.
        if current != newest_revision():
            command.upgrade(alembic_config(connection), revision)
        if new and fill is not None:
            with Session(connection) as session:
                fill(session)
                session.flush()
    return new
