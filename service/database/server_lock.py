"""Lock that tells other processes that a server uses the database."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

from sqlalchemy import event
from sqlalchemy.exc import SQLAlchemyError

from service.database.engine import Database, file_of
from service.problems.errors import DatabaseInUse

# One for each schema: several databases of the service may be schemas of one of PostgreSQL.
_ARGUMENTS: Final = "(5421079, hashtext(current_schema()))"


@contextmanager
def server_lock(database: Database) -> Iterator[None]:
    """Let others know while a server uses a database; waits while one is being restored."""
    if database.engine.dialect.name == "postgresql":
        # Held by every connection, so that it comes back with them when PostgreSQL was restarted.
        event.listen(database.engine, "connect", _share)
        try:
            yield
        finally:
            event.remove(database.engine, "connect", _share)
        return
    with ExitStack() as stack:
        file = file_of(database)
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
            fcntl.flock(stack.enter_context(_lock_file(file)), fcntl.LOCK_SH)
        yield


def is_unused(url: str) -> bool:
    """Whether no server uses a database now; one that starts asks before it takes its lock."""
    # A connection of its own, as it must not come back with the ones that share the lock.
    database = Database(url)
    try:
        with exclusive_lock(database):
            return True
    except (DatabaseInUse, SQLAlchemyError, OSError):  # or there is none yet
        return False
    finally:
        database.close()


@contextmanager
def exclusive_lock(database: Database) -> Iterator[None]:
    """Keep servers from using a database meanwhile; raises DatabaseInUse when one does."""
    if database.engine.dialect.name == "postgresql":
        with database.engine.connect() as connection:
            locked = connection.exec_driver_sql(f"SELECT pg_try_advisory_lock{_ARGUMENTS}")
            if not locked.scalar():
                raise _in_use()
            connection.commit()  # no transaction is left open; the lock is the session's
            try:
                yield
            finally:
                connection.exec_driver_sql(f"SELECT pg_advisory_unlock{_ARGUMENTS}")
                connection.commit()
        return
    with ExitStack() as stack:
        file = file_of(database)
        if file is not None:
            try:
                fcntl.flock(stack.enter_context(_lock_file(file)), fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise _in_use() from None
        yield


def _share(connection: Any, _record: object) -> None:
    with connection.cursor() as cursor:
        cursor.execute(f"SELECT pg_advisory_lock_shared{_ARGUMENTS}")
    connection.commit()


@contextmanager
def _lock_file(database: Path) -> Iterator[int]:
    # It stays where it is: were it deleted, two could hold locks of two files of its name.
    opened = os.open(database.with_suffix(".lock"), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        yield opened
    finally:
        os.close(opened)


def _in_use() -> DatabaseInUse:
    return DatabaseInUse("a server uses the database; stop it first")
