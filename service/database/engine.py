"""The database engine and its transactions, for SQLite and PostgreSQL."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from sqlalchemy import Connection, Engine, create_engine, event, text
from sqlalchemy.engine import make_url
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

_BUSY_TIMEOUT_MS = 5000


class Database:
    """One database; ``read`` and ``write`` give sessions that are one transaction each."""

    def __init__(self, url: str) -> None:
        """Make the engine; nothing is connected yet.

        Args:
            url: SQLAlchemy URL, ``sqlite:///file`` or ``postgresql+psycopg://...``.
        """
        sqlite = make_url(url).get_backend_name() == "sqlite"
        self.engine = create_engine(url, pool_pre_ping=not sqlite)
        if sqlite:
            _configure_sqlite(self.engine)
        self._writer = self.engine.execution_options(lumiline_write=True)

    @contextmanager
    def read(self) -> Iterator[Session]:
        """Yield a session for reading; nothing is committed."""
        with Session(self.engine) as session:
            yield session

    @contextmanager
    def write(self) -> Iterator[Session]:
        """Yield a session for writing; commits at the end, rolls back on an exception."""
        with Session(self._writer) as session, session.begin():
            yield session

    def check(self) -> None:
        """Raise SQLAlchemyError when the database does not answer."""
        with self.engine.connect() as connection:
            connection.execute(text("SELECT 1"))

    def close(self) -> None:
        """Close all connections."""
        self.engine.dispose()


def insert(session: Session, row: object, taken: Exception) -> None:
    """Insert a row at once; raises ``taken`` when another transaction was first with its key.

    The caller has looked for the key before: this is for two requests at the same moment.
    """
    session.add(row)
    try:
        session.flush()
    except IntegrityError as error:
        raise taken from error


def _configure_sqlite(engine: Engine) -> None:
    @event.listens_for(engine, "connect")
    def connect(connection: Any, _record: object) -> None:
        # Python's sqlite3 would begin transactions by itself, and too late; see begin().
        connection.isolation_level = None
        cursor = connection.cursor()
        cursor.execute("PRAGMA journal_mode = WAL")
        cursor.execute("PRAGMA synchronous = NORMAL")
        cursor.execute("PRAGMA foreign_keys = ON")
        cursor.execute(f"PRAGMA busy_timeout = {_BUSY_TIMEOUT_MS}")
        cursor.close()

    @event.listens_for(engine, "begin")
    def begin(connection: Connection) -> None:
        # A transaction that reads first and writes later cannot wait for another writer: it
        # fails at once. One that is going to write takes the lock at its beginning.
        write = connection.get_execution_options().get("lumiline_write", False)
        connection.exec_driver_sql("BEGIN IMMEDIATE" if write else "BEGIN")
