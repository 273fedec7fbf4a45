"""The database engine and its transactions, for SQLite and PostgreSQL."""

import logging
import os
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from pydantic_core import to_json
from sqlalchemy import Connection, Engine, Select, create_engine, event, select, text
from sqlalchemy.engine import make_url
from sqlalchemy.exc import DBAPIError, IntegrityError, InterfaceError, OperationalError
from sqlalchemy.exc import TimeoutError as NoFreeConnection
from sqlalchemy.orm import Session

from compute.errors import LumilineError
from service.database.audited_session import AuditedSession
from service.database.connection_options import connect_with_timeout, timeouts
from service.database.models import Base
from service.problems.errors import DatabaseFull, NotReady

_log = logging.getLogger(__name__)

POOL_TIMEOUT_S = 5
"""How long a request waits for a connection while others have all."""
_BUSY_TIMEOUT_MS = 5000
_SQLITE_FULL = (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR_SHMSIZE)
"""Codes of SQLite for a disk without room; the second: none for the index of its log."""
_POSTGRESQL_DISK_FULL = "53100"


def _json(value: object) -> str:
    """Return a value as JSON; the standard library holds the lock for seven times as long."""
    return to_json(value, inf_nan_mode="constants").decode()


class Database:
    """One database; ``read`` and ``write`` give sessions that are one transaction each."""

    def __init__(self, url: str, *, query_timeout: bool = False) -> None:
        """Make the engine; nothing is connected yet.

        Args:
            url: SQLAlchemy URL, ``sqlite:///file`` or ``postgresql+psycopg://...``.
            impatient: a statement to PostgreSQL that takes long fails, as those do that requests
                wait for; a migration or a copy may take its time.
        """
        parts = make_url(url)
        sqlite = parts.get_backend_name() == "sqlite"
        postgresql = parts.get_backend_name() == "postgresql"
        self.engine = create_engine(
            parts,
            json_serializer=_json,
            pool_pre_ping=not sqlite,
            pool_timeout=POOL_TIMEOUT_S,
            connect_args=timeouts(parts, statements=query_timeout) if postgresql else {},
        )
        if sqlite:
            _configure_sqlite(self.engine)
        elif postgresql and query_timeout:
            connect_with_timeout(self.engine)
        self._writer = self.engine.execution_options(lumiline_write=True)

    @contextmanager
    def read(self) -> Iterator[Session]:
        """Yield a session for reading; nothing is committed. Raises NotReady."""
        with _answering(), Session(self.engine) as session:
            yield session

    @contextmanager
    def write(self) -> Iterator[Session]:
        """Yield a session for writing; commits at the end, rolls back on an exception.

        What is changed through it is written into the audit log with it.

        Raises:
            NotReady: the database does not answer, or another process keeps it locked.
            DatabaseFull: its disk has no room.
        """
        with _answering(), AuditedSession(self._writer) as session, session.begin():
            yield session

    def check(self) -> None:
        """Raise SQLAlchemyError when the database does not answer."""
        with self.engine.connect() as connection:
            connection.execute(text("SELECT 1"))

    def close(self) -> None:
        """Close all connections."""
        self.engine.dispose()


@contextmanager
def _answering() -> Iterator[None]:
    """Turn the failures of a database that does not answer into NotReady, or DatabaseFull."""
    try:
        yield
    except (OperationalError, InterfaceError, NoFreeConnection) as error:
        # The driver's text is for the log: it may hold the server's address and user.
        cause = error.orig if isinstance(error, DBAPIError) else error
        _log.error("database: %s", cause)
        if _is_full(cause):
            raise DatabaseFull(
                "the disk of the database is full, so nothing was stored; make room on it: delete "
                "recordings or exports",
                part="database",
            ) from error
        raise NotReady(
            f"the database is locked or does not answer ({type(error).__name__}); try again, and "
            "look into the server's log when it stays so",
            part="database",
        ) from error


def _is_full(cause: BaseException | None) -> bool:
    return (
        getattr(cause, "sqlite_errorcode", None) in _SQLITE_FULL
        or getattr(cause, "sqlstate", None) == _POSTGRESQL_DISK_FULL
    )


Row = TypeVar("Row", bound=Base)


@dataclass(frozen=True)
class Resource(Generic[Row]):
    """A table whose rows clients know by id: finds, lists and inserts rows.

    Args:
        row: the table.
        key: of an id in the context of errors; with hyphens and an s the path of the list.
        unknown: raised where no row has an id.
        exists: raised where an id is taken that a client chose.
        name: of a row in messages; None: its key.
        taken: what is said of an id that is taken.
        path: of the list; None: from the key.
    """

    row: type[Row]
    key: str
    unknown: type[LumilineError]
    exists: type[LumilineError] = LumilineError
    name: str | None = None
    taken: str = "exists already; choose another id, or leave it out"
    path: str | None = None

    def get(self, session: Session, identity: str, *, lock: bool = False) -> Row:
        """Return the row of an id, locked until the transaction's end on request."""
        row = session.get(self.row, identity, with_for_update=lock or None)
        if row is None:
            path = self.path or f"/api/v1/{self.key.replace('_', '-')}s"
            detail = f'there is no {self._name} "{identity}"; GET {path} lists them'
            raise self.unknown(detail, **{f"{self.key}_id": identity})
        return row

    def newest_first(self, **columns: object) -> Select[Row]:
        """Return the rows whose columns have these values, newest first; None: any value."""
        table: Any = self.row
        filters = {name: value for name, value in columns.items() if value is not None}
        return select(table).filter_by(**filters).order_by(table.created_at.desc(), table.id)

    def check_unused(self, session: Session, identity: str | None) -> None:
        """Raise an error where the id that a client chose is taken."""
        if identity is not None and session.get(self.row, identity) is not None:
            raise self._conflict(identity)

    def insert(self, session: Session, row: Row) -> Row:
        """Insert a row and return it; raises an error where its id is taken."""
        identity = str(row.__dict__["id"])
        self.check_unused(session, identity)
        insert(session, row, self._conflict(identity))
        return row

    @property
    def _name(self) -> str:
        return self.name or self.key.replace("_", " ")

    def _conflict(self, identity: str) -> LumilineError:
        return self.exists(
            f'{self._name} "{identity}" {self.taken}', **{f"{self.key}_id": identity}
        )


def insert(session: Session, row: object, taken: Exception) -> None:
    """Insert a row at once; raises ``taken`` when another transaction was first with its key.

    The caller has looked for the key before: this is for two requests at the same moment.
    """
    session.add(row)
    try:
        session.flush()
    except IntegrityError as error:
        raise taken from error


def file_of(database: Database) -> Path | None:
    """Return the file of a SQLite database; None of one in memory."""
    name = database.engine.url.database
    return Path(name) if name and name != ":memory:" and not name.startswith("file:") else None


def _configure_sqlite(engine: Engine) -> None:
    @event.listens_for(engine, "do_connect")
    def make(*_: object) -> None:
        # Its owner's alone, as SQLite then makes the files beside it, too.
        name = engine.url.database
        if name and name != ":memory:" and not name.startswith("file:"):
            with suppress(OSError):  # SQLite says what is wrong
                os.close(os.open(name, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600))

    @event.listens_for(engine, "connect")
    def connect(connection: Any, _record: object) -> None:
        # Python's sqlite3 would begin transactions by itself, and too late; see begin().
        connection.isolation_level = None
        cursor = connection.cursor()
        cursor.execute("PRAGMA journal_mode = WAL")
        # NORMAL could lose the last transactions, which were answered, when the power fails.
        cursor.execute("PRAGMA synchronous = FULL")
        cursor.execute("PRAGMA foreign_keys = ON")
        cursor.execute(f"PRAGMA busy_timeout = {_BUSY_TIMEOUT_MS}")
        cursor.close()

    @event.listens_for(engine, "begin")
    def begin(connection: Connection) -> None:
        # A transaction that reads first and writes later cannot wait for another writer: it
        # fails at once. One that is going to write takes the lock at its beginning.
        write = connection.get_execution_options().get("lumiline_write", False)
        connection.exec_driver_sql("BEGIN IMMEDIATE" if write else "BEGIN")
