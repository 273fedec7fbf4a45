"""Restores a backup into a database of either kind in one transaction; revoked keys stay so."""

import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from alembic import command
from alembic.util import CommandError
from sqlalchemy import Connection, inspect, or_, select, update
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from service.backup.backup import back_up, opened
from service.backup.checksum import copy_checked
from service.backup.consistency import find_inconsistencies
from service.backup.copy_rows import TableCopied, copy_rows, count_rows
from service.database.audited_session import entry
from service.database.engine import Database
from service.database.migration import (
    alembic_config,
    lock_schema,
    migrate,
    newest_revision,
    revision_of,
)
from service.database.models import ApiKeyRow, Base
from service.database.server_lock import exclusive_lock
from service.problems.errors import BackupUnusable, DatabaseDamaged, DatabaseNotEmpty


@dataclass(frozen=True)
class KeyChanges:
    """Keys that a restore changed, by their ids.

    Args:
        revoked: valid in the backup, and revoked now as they were in what was replaced.
        valid: valid now, and unknown to what was replaced.
        lost: valid in what was replaced, and not in the backup: nobody can use them any more.
    """

    revoked: tuple[str, ...] = ()
    valid: tuple[str, ...] = ()
    lost: tuple[str, ...] = ()


@dataclass(frozen=True)
class ApiKeySnapshot:
    """The keys of a database: when each was revoked, and which are valid."""

    revoked_at: dict[str, datetime | None]
    valid: frozenset[str]


NO_KEYS = ApiKeySnapshot({}, frozenset())


@dataclass(frozen=True)
class Restored:
    """Result of a restore.

    Args:
        counts: how many rows each table has.
        kept: the backup of what was there, if anything was.
        keys: which API keys can be used, or not, unlike before.
    """

    counts: dict[str, int]
    previous: Path | None
    keys: KeyChanges


def restore(
    database: Database, file: Path, keep_in: Path | None, report: TableCopied | None = None
) -> Restored:
    """Put a backup's content in the place of what a database holds.

    The backup is checked, and brought to the newest revision, before anything is changed; what was
    there is backed up first. The change is one transaction, at the end of which the database is
    checked again. Keys that were revoked since the backup stay so.

    Args:
        database: the database.
        file: the backup.
        keep_in: the folder for the backup of what was there; None: only an empty database is taken.
        report: hears of every table that is done.

    Raises:
        DatabaseInUse: a server uses the database.
        BackupUnusable: the file is no backup, damaged, or of a later version.
        DatabaseNotEmpty: the database holds something, and ``keep_in`` is None.
        DatabaseDamaged: what was restored does not agree with itself; nothing was changed.
    """
    with _ready(file) as source, exclusive_lock(database):
        previous = _keep(database, keep_in)
        engine = database.engine.execution_options(lumiline_write=True)
        with engine.begin() as target:
            before = read_api_keys(target) if previous is not None else NO_KEYS
            _clear(target)
            command.upgrade(alembic_config(target), "head")
            counts = copy_rows(source, target, report)
            inconsistencies = find_inconsistencies(target)
            if inconsistencies or count_rows(target) != counts:
                raise DatabaseDamaged(
                    "what was restored does not agree with itself: "
                    f"{'; '.join(inconsistencies[:5])}; nothing was changed"
                )
            keys = keep_revoked(target, before)
            after = {"backup": file.name, "keys_revoked": list(keys.revoked)}
            with Session(target) as session:
                session.add(entry("database", None, "done", after=after))
                session.flush()
    return Restored(counts, previous, keys)


@contextmanager
def _ready(file: Path) -> Iterator[Connection]:
    """Yield a checked copy of a backup, of the newest revision."""
    if not file.is_file():
        raise BackupUnusable(f"{file} is no file")
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "backup"
        copy_checked(file, copy)
        with opened(copy, file) as connection:
            revision = revision_of(connection)
        updated = Database(f"sqlite:///{copy}")
        try:
            migrate(updated)
        except CommandError as error:
            raise BackupUnusable(
                f"{file} is of revision {revision}, which this version does not know; restore it "
                "with the version that made it, or a newer one"
            ) from error
        except SQLAlchemyError as error:
            raise BackupUnusable(f"{file} is damaged: {error}") from error
        finally:
            updated.close()
        with opened(copy, file) as connection:
            inconsistencies = _inconsistencies(file, connection)
            if inconsistencies:
                raise BackupUnusable(f"{file} is damaged: {'; '.join(inconsistencies[:5])}")
            yield connection


def _inconsistencies(file: Path, connection: Connection) -> list[str]:
    try:
        return find_inconsistencies(connection)
    except (SQLAlchemyError, sqlite3.Error, ValueError) as error:
        raise BackupUnusable(f"{file} is damaged: {error}") from error


def _keep(database: Database, keep_in: Path | None) -> Path | None:
    """Back up what a database holds; return the file, None when it holds nothing."""
    with database.engine.connect() as connection:
        revision = revision_of(connection)
        if revision is None:
            return None
        if keep_in is None:
            raise DatabaseNotEmpty(
                "the database is not empty; say --replace to have its content backed up and then "
                "replaced"
            )
        newest = newest_revision()
    if revision != newest:
        migrate(database)
    previous = keep_in / f"before-restore-{datetime.now(UTC):%Y%m%dT%H%M%S%f}.lumiline"
    back_up(database, previous)
    return previous


def _clear(target: Connection) -> None:
    """Drop our tables, whatever their triggers say of single rows."""
    lock_schema(target)
    there = set(inspect(target).get_table_names())
    ours = [table for table in Base.metadata.sorted_tables if table.name in there]
    Base.metadata.drop_all(target, tables=ours)
    if "alembic_version" in there:
        target.exec_driver_sql("DROP TABLE alembic_version")


def read_api_keys(connection: Connection) -> ApiKeySnapshot:
    """Return what a database knows of keys."""
    query = select(ApiKeyRow.id, ApiKeyRow.revoked_at, ApiKeyRow.expires_at)
    rows = connection.execute(query).all()
    now = datetime.now(UTC)
    return ApiKeySnapshot(
        {identity: revoked for identity, revoked, _ in rows},
        frozenset(
            identity
            for identity, revoked, expires in rows
            if revoked is None and (expires is None or expires > now)
        ),
    )


def keep_revoked(connection: Connection, before: ApiKeySnapshot) -> KeyChanges:
    """Revoke, among the restored keys, those that were revoked before; return what changed."""
    restored = read_api_keys(connection)
    for identity, moment in before.revoked_at.items():
        if moment is not None:
            earlier = or_(ApiKeyRow.revoked_at.is_(None), ApiKeyRow.revoked_at > moment)
            here = update(ApiKeyRow).where(ApiKeyRow.id == identity, earlier)
            connection.execute(here.values(revoked_at=moment))
    now = read_api_keys(connection)
    return KeyChanges(
        revoked=tuple(sorted(restored.valid - now.valid)),
        valid=tuple(sorted(now.valid - before.revoked_at.keys())),
        lost=tuple(sorted(before.valid - restored.revoked_at.keys())),
    )
