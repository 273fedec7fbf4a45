"""Writes a backup, a SQLite file, of a database of either kind while it is in use."""

import os
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from sqlalchemy import Connection

from service.backup.checksum import add_checksum
from service.backup.consistency import find_inconsistencies
from service.backup.copy_rows import TableCopied, copy_rows, count_rows
from service.database.engine import Database
from service.database.migration import migrate, newest_revision, revision_of
from service.problems.errors import BackupUnusable, DatabaseDamaged


def back_up(database: Database, file: Path, report: TableCopied | None = None) -> dict[str, int]:
    """Write all that a database holds into a new file; return how many rows each table has.

    It is one moment's content. The file is checked before it gets its name, and only its owner may
    read it.

    Raises:
        FileExistsError: there is one of the name.
        OSError: it cannot be written.
        DatabaseDamaged: what was written does not agree with itself, as the database does not, or
            it is of another revision than this version's.
    """
    if file.exists():
        raise FileExistsError(f"{file} exists already; give another name")
    _check_revision(database)
    file.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{file.name}-", dir=file.parent) as folder:
        copy = Path(folder) / "backup"
        if database.engine.dialect.name == "sqlite":
            _copy_file(database, copy)
        else:
            _copy_content(database, copy, report)
        with opened(copy) as connection:
            inconsistencies = find_inconsistencies(connection)
            counts = count_rows(connection)
        if inconsistencies:
            raise DatabaseDamaged(
                f"the backup was not kept, as what it holds does not agree with itself: "
                f"{'; '.join(inconsistencies[:5])}"
            )
        _keep(copy, file)
    return counts


def _check_revision(database: Database) -> None:
    with database.engine.connect() as connection:
        revision, newest = revision_of(connection), newest_revision()
    if revision != newest:
        raise DatabaseDamaged(
            f"the database is of revision {revision or 'none'}, and this version's is {newest}; "
            "start this version's service on it first, or back it up with the version that wrote it"
        )


@contextmanager
def opened(file: Path, name: Path | None = None) -> Iterator[Connection]:
    """Yield a connection to a backup; raises BackupUnusable, of its name, when it is none."""
    database = Database(f"sqlite:///{file}")
    try:
        with closing(sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro", uri=True)) as probe:
            probe.execute("SELECT version_num FROM alembic_version").fetchall()
        with database.engine.connect() as connection:
            yield connection
    except sqlite3.Error as error:
        raise BackupUnusable(f"{name or file} is no backup of this service: {error}") from error
    finally:
        database.close()


def _copy_file(database: Database, copy: Path) -> None:
    """SQLite's own online backup: writers go on meanwhile."""
    with closing(sqlite3.connect(copy)) as target:
        raw = database.engine.raw_connection()
        try:
            source = raw.driver_connection
            assert isinstance(source, sqlite3.Connection)
            source.backup(target)
        finally:
            raw.close()


def _copy_content(database: Database, copy: Path, report: TableCopied | None) -> None:
    target = Database(f"sqlite:///{copy}")
    try:
        migrate(target)
        snapshot = database.engine.execution_options(
            isolation_level="REPEATABLE READ", postgresql_readonly=True
        )
        with (
            snapshot.connect() as source,
            target.engine.execution_options(lumiline_write=True).begin() as connection,
        ):
            copy_rows(source, connection, report)
    finally:
        target.close()


def _keep(copy: Path, file: Path) -> None:
    # A database in WAL mode may be of several files.
    with closing(sqlite3.connect(copy)) as connection:
        connection.execute("PRAGMA journal_mode = DELETE")
    add_checksum(copy)
    copy.chmod(0o600)
    with copy.open("rb") as written:
        os.fsync(written.fileno())
    os.link(copy, file)  # unlike a rename it never replaces one that came meanwhile
