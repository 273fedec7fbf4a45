"""Brings a database to the newest revision of migrations/."""

from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from sqlalchemy import Connection

import migrations
from service.database.engine import Database


def alembic_config(connection: Connection) -> Config:
    """Return Alembic's configuration for a connection; its revisions are in ``migrations``."""
    config = Config()
    config.set_main_option("script_location", str(Path(migrations.__file__).parent))
    config.set_main_option("path_separator", "os")
    config.attributes["connection"] = connection
    return config


def migrate(database: Database, revision: str = "head") -> bool:
    """Upgrade the database to ``revision`` in one transaction; return whether it was new."""
    with database.engine.execution_options(lumiline_write=True).begin() as connection:
        if connection.dialect.name == "postgresql":
            # Several servers may start at once; the lock ends with the transaction.
            connection.exec_driver_sql("SELECT pg_advisory_xact_lock(5421078)")
        new = MigrationContext.configure(connection).get_current_revision() is None
        command.upgrade(alembic_config(connection), revision)
    return new
