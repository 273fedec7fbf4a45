"""Backups of either database, restored into either: the same rows, or nothing."""

import os
import shutil
import sqlite3
import stat
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

import pytest
from sqlalchemy import select, text
from typer.testing import CliRunner

from service.api.correction_tables.store import add_table, find_parent
from service.api.radiometric_calibrations.content import RadiometricContent, sensor_calibrations
from service.api.radiometric_calibrations.examples import NEW_RADIOMETRIC_CALIBRATIONS
from service.api.radiometric_calibrations.store import activate, add_radiometric_calibration
from service.application.initial_content import seed
from service.backup import restore as restoring
from service.backup.backup import back_up
from service.backup.checksum import CHECKSUM_BYTES, add_checksum
from service.backup.consistency import find_inconsistencies
from service.backup.restore import KeyChanges, restore
from service.cli import app
from service.database.engine import Database
from service.database.migration import migrate
from service.database.models import (
    ActivationRow,
    ApiKeyRow,
    AuditRow,
    CalibrationRow,
    CorrectionTableRow,
    DeviceRow,
)
from service.database.server_lock import server_lock
from service.problems.errors import BackupUnusable, DatabaseDamaged, DatabaseInUse, DatabaseNotEmpty
from service.security import store
from tests.service.api.correction_tables.tables import content as content_of_table
from tests.service.conftest import postgres_schema
from tests.service.database.sample_rows import Rows, content, fill


@pytest.fixture
def filled(database: Database) -> Database:
    """Sound content in every table: a calibration and a table that agree with their hashes."""
    with database.write() as session:
        parent = session.get_one(CalibrationRow, "sim-nominal")
        found = content_of_table(parent.content_hash)
        add_table(session, found, find_parent(session, found), "upload", "", "t")
        session.get_one(DeviceRow, "sim").title = "Backed up"
        sensors = NEW_RADIOMETRIC_CALIBRATIONS["document"]["value"]["source"]["sensors"]
        pixels = RadiometricContent("sim", sensor_calibrations(sensors))
        activate(session, add_radiometric_calibration(session, pixels, "document", "", "r"), None)
    with database.engine.begin() as connection:
        fill(connection)
    return database


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.postgres)])
def target(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Database]:
    """An empty database, of each kind."""
    schema = postgres_schema() if request.param == "postgresql" else None
    url = f"sqlite:///{tmp_path / 'target.sqlite3'}" if schema is None else next(schema)
    opened = Database(url)
    yield opened
    opened.close()
    for _ in schema or ():
        pass


def rows_of(database: Database) -> Rows:
    with database.engine.connect() as connection:
        return content(connection)


def without_entry_of_restore(found: Rows) -> Rows:
    log = found["audit_log"]
    told = {"backup": "b", "keys_revoked": []}
    assert (log[-1]["object_kind"], log[-1]["after"]) == ("database", told)
    return found | {"audit_log": log[:-1]}


@pytest.mark.slow
def test_each_restored_into_each(filled: Database, target: Database, tmp_path: Path) -> None:
    counts = back_up(filled, tmp_path / "b")
    assert all(counts.values()), counts
    assert stat.S_IMODE((tmp_path / "b").stat().st_mode) == 0o600
    assert [one.name for one in tmp_path.glob("*b*")] == ["b"]  # one file, nothing left beside it
    restored = restore(target, tmp_path / "b", None)
    assert (restored.counts, restored.previous) == (counts, None)
    assert without_entry_of_restore(rows_of(target)) == rows_of(filled)
    with target.engine.connect() as connection:
        assert find_inconsistencies(connection) == []
    # New rows are numbered after those that were there.
    with target.write() as session:
        session.get_one(DeviceRow, "sim").title = "After"
        session.flush()
        ids = session.scalars(select(AuditRow.id).order_by(AuditRow.id)).all()
        last = session.scalars(select(ActivationRow.id).order_by(ActivationRow.id.desc())).first()
    assert len(ids) == counts["audit_log"] + 2
    assert last is not None


SQLITE_SOURCE = pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)


@pytest.mark.slow
@SQLITE_SOURCE
def test_what_was_there_is_kept(database: Database, target: Database, tmp_path: Path) -> None:
    back_up(database, tmp_path / "b")
    migrate(target, fill=seed)
    with target.write() as session:
        session.get_one(DeviceRow, "sim").title = "Replaced"
    before = rows_of(target)
    with pytest.raises(DatabaseNotEmpty, match="--replace"):
        restore(target, tmp_path / "b", None)
    assert rows_of(target) == before
    kept = restore(target, tmp_path / "b", tmp_path / "kept").previous
    assert without_entry_of_restore(rows_of(target)) == rows_of(database)
    assert kept is not None
    restore(target, kept, tmp_path / "kept")
    assert rows_of(target)["devices"] == before["devices"]


@pytest.mark.slow
@SQLITE_SOURCE
def test_a_restore_that_fails_changes_nothing(
    database: Database, target: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    back_up(database, tmp_path / "b")
    migrate(target, fill=seed)
    with target.write() as session:
        session.get_one(DeviceRow, "sim").title = "Stays"
    before = rows_of(target)
    copy = restoring.copy_rows

    def lose_one(*arguments: object) -> dict[str, int]:
        counts = copy(*arguments)  # type: ignore[arg-type]
        return counts | {"devices": counts["devices"] + 1}

    monkeypatch.setattr(restoring, "copy_rows", lose_one)
    with pytest.raises(DatabaseDamaged, match="nothing was changed"):
        restore(target, tmp_path / "b", tmp_path / "kept")
    assert rows_of(target) == before
    with target.engine.connect() as connection:
        assert find_inconsistencies(connection) == []


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a database, source.sqlite3, and its backup, b."""
    folder = tmp_path_factory.mktemp("made")
    database = Database(f"sqlite:///{folder / 'source.sqlite3'}")
    migrate(database, fill=seed)
    with database.write() as session:
        parent = session.get_one(CalibrationRow, "sim-nominal")
        found = content_of_table(parent.content_hash)
        add_table(session, found, find_parent(session, found), "upload", "", "t")
    back_up(database, folder / "b")
    database.close()
    return folder


@pytest.fixture
def backup(made: Path, tmp_path: Path) -> Path:
    """A copy of the backup."""
    return Path(shutil.copy(made / "b", tmp_path / "b"))


@pytest.fixture
def source(made: Path, tmp_path: Path) -> Iterator[Database]:
    """A copy of the database."""
    opened = Database(f"sqlite:///{shutil.copy(made / 'source.sqlite3', tmp_path)}")
    yield opened
    opened.close()


def add_key(database: Database, *, revoked: datetime | None = None) -> str:
    with database.write() as session:
        row, _ = store.add_key(session, name="k", scopes=["read:stream"])
        row.revoked_at = revoked
        return row.id


@pytest.mark.slow
@SQLITE_SOURCE
def test_a_revoked_key_stays_so(database: Database, target: Database, tmp_path: Path) -> None:
    earlier = datetime(2024, 1, 1, tzinfo=UTC)
    revoked, kept, early = (add_key(database) for _ in range(3))
    both = add_key(database, revoked=earlier)
    back_up(database, tmp_path / "b")
    first = restore(target, tmp_path / "b", None)
    assert first.keys == KeyChanges(valid=tuple(sorted((revoked, kept, early))))
    with target.write() as session:
        for identity in (revoked, early):
            store.revoke_key(session, identity)
        moment = session.get_one(ApiKeyRow, revoked).revoked_at
    late, dead = add_key(target), add_key(target, revoked=earlier)
    again = restore(target, tmp_path / "b", tmp_path / "kept")
    assert again.keys == KeyChanges(tuple(sorted((revoked, early))), (), (late,))
    with target.read() as session:
        found = {row.id: row.revoked_at for row in session.scalars(select(ApiKeyRow))}
        entries = session.scalars(select(AuditRow.after).order_by(AuditRow.id)).all()
    assert found.pop(early) is not None
    assert found == {revoked: moment, kept: None, both: earlier}
    assert dead not in found
    assert entries[-1] == {"backup": "b", "keys_revoked": sorted((revoked, early))}
    assert again.previous is not None
    assert restore(target, again.previous, tmp_path / "kept").keys.valid == (late,)


@pytest.mark.slow
@SQLITE_SOURCE
def test_not_under_a_server(database: Database, target: Database, tmp_path: Path) -> None:
    back_up(database, tmp_path / "b")
    migrate(target, fill=seed)
    server = Database(target.engine.url.render_as_string(hide_password=False), query_timeout=True)
    with server_lock(server):
        server.check()
        with pytest.raises(DatabaseInUse, match="stop it first"):
            restore(target, tmp_path / "b", tmp_path / "kept")
        assert not (tmp_path / "kept").exists()
        server.close()
    restore(target, tmp_path / "b", tmp_path / "kept")


DAMAGE = {
    "calibration": (
        "UPDATE calibrations SET content = json_set(content, '$.device', 'other')",
        'calibration "sim-nominal" is not what it was',
    ),
    "hash": (
        f"UPDATE calibrations SET content_hash = '{'0' * 64}'",
        'table "t" is of another content than its calibration',
    ),
    "table": (
        "UPDATE correction_tables SET data = substr(data, 1, 2000)",
        'correction table "t" is not what it was',
    ),
    "pointer": (
        "UPDATE active_calibrations SET table_id = 't'",
        'device "sim" does not use what its last activation says',
    ),
    "history": (
        "UPDATE activations SET previous_calibration_id = 'x'",
        "does not follow the one before",
    ),
    "reference": ("DELETE FROM devices", "refers to a row of devices that is not there"),
    "json": ("UPDATE devices SET title = title, sensors = 'not json'", "of the table devices"),
    "moment": (
        "UPDATE active_calibrations SET table_id = NULL; UPDATE devices SET created_at = 'noon'",
        "a value of the table devices cannot be read",
    ),
    "sensors": ("UPDATE devices SET sensors = 'null'", 'device "sim" has sensors'),
    "source": (
        'UPDATE devices SET source = \'{"kind": "alien"}\'',
        'device "sim" has a source that this version cannot read',
    ),
    "no table": ("DROP TABLE watches", "the table watches is missing"),
    "no column": ("ALTER TABLE runs DROP COLUMN stage", "the column stage of runs is missing"),
    "later": ("UPDATE alembic_version SET version_num = '9999'", "revision 9999"),
    "no revision": ("DROP TABLE alembic_version", "no backup of this service"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", DAMAGE)
def test_a_damaged_backup_is_refused(backup: Path, tmp_path: Path, name: str) -> None:
    statement, complaint = DAMAGE[name]
    os.truncate(backup, backup.stat().st_size - CHECKSUM_BYTES)
    with closing(sqlite3.connect(backup)) as connection:
        for (trigger,) in connection.execute(
            "SELECT name FROM sqlite_master WHERE type = 'trigger'"
        ).fetchall():
            connection.execute(f"DROP TRIGGER {trigger}")
        connection.executescript(statement)
        connection.commit()
    add_checksum(backup)
    target = Database(f"sqlite:///{tmp_path / 'target.sqlite3'}")
    try:
        with pytest.raises(BackupUnusable, match=complaint) as caught:
            restore(target, backup, None)
        assert caught.value.detail.startswith(f"{backup} is ")
        with target.engine.connect() as connection:
            assert connection.execute(text("SELECT name FROM sqlite_master")).all() == []
    finally:
        target.close()


def test_a_file_that_is_no_backup(backup: Path, tmp_path: Path) -> None:
    files = [tmp_path / "nothing", tmp_path]
    for size in (0, 100, 5000):
        files.append(tmp_path / f"cut-{size}")
        files[-1].write_bytes(backup.read_bytes()[:size])
    target = Database(f"sqlite:///{tmp_path / 'target.sqlite3'}")
    try:
        for file in files:
            with pytest.raises(BackupUnusable) as caught:
                restore(target, file, None)
            assert caught.value.detail.startswith(f"{file} is ")
    finally:
        target.close()


def test_a_damaged_database_is_not_backed_up(source: Database, tmp_path: Path) -> None:
    with source.engine.begin() as connection:
        connection.exec_driver_sql("DROP TRIGGER correction_tables_unchanged")
        connection.execute(text("UPDATE correction_tables SET content_hash = 'x' WHERE id = 't'"))
    with pytest.raises(DatabaseDamaged, match='table "t" is not what it was'):
        back_up(source, tmp_path / "again")
    assert not (tmp_path / "again").exists()


def test_a_backup_is_one_moment_while_others_write(source: Database, tmp_path: Path) -> None:
    with source.write() as session:
        session.get_one(DeviceRow, "sim").title = "Not yet"
        session.flush()
        back_up(source, tmp_path / "meanwhile")
    with closing(sqlite3.connect(tmp_path / "meanwhile")) as connection:
        assert "Not yet" not in connection.execute("SELECT title FROM devices").fetchone()[0]


@pytest.mark.slow
def test_the_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("LUMILINE_DATABASE_URL", raising=False)

    def lumiline(*arguments: str, code: int = 0) -> str:
        given = [*arguments, "--data-dir", "data"]
        result = CliRunner().invoke(app, given)
        assert result.exit_code == code, result.output
        return result.output

    key = lumiline("keys", "create", "ada", "--scope", "read:stream", "--days", "2").split()[-1]
    assert key.startswith("lumi_")
    assert "ada" in lumiline("keys", "list")
    assert '"state": "valid"' in lumiline("keys", "list", "--json")
    assert "1 devices" in lumiline("backup", "b")
    assert "exists; choose" in lumiline("backup", "b", code=2)
    assert "not empty" in lumiline("restore", "b", code=2)
    lumiline("keys", "revoke", key.split("_")[1])
    assert '"state": "revoked"' in lumiline("keys", "list", "--json")
    said = lumiline("restore", "b", "--replace")
    assert "before-restore-" in said
    assert f"keys {key.split('_')[1]}: valid in the backup, and stay revoked" in said
    assert '"state": "revoked"' in lumiline("keys", "list", "--json")
    for file in Path("data").iterdir():
        assert not stat.S_IMODE(file.stat().st_mode) & 0o077, file
    assert "sound" in lumiline("check-database")
    assert "no key" in lumiline("keys", "revoke", "nothing", code=2)
    assert "everything" in lumiline("keys", "create", "x", "--scope", "everything", code=2)
    with closing(sqlite3.connect("data/lumiline.sqlite3")) as connection:
        connection.execute("DROP TRIGGER audit_log_kept")
    assert "audit_log_kept is missing" in lumiline("check-database", code=1)
    database = Database("sqlite:///data/lumiline.sqlite3")
    with database.read() as session:
        told = session.scalars(select(AuditRow.operation).order_by(AuditRow.id)).all()
        assert session.get(CorrectionTableRow, "t") is None
    database.close()
    assert told == ["lumiline keys create", "lumiline restore"]
