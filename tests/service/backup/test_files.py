"""Backups of database, recordings and profiles together."""

import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from service.backup.files import (
    DATABASE,
    back_up_files,
    backups_in,
    last_backup,
    restore_files,
)
from service.database.engine import Database
from service.database.migration import migrate
from service.problems.errors import BackupUnusable
from service.settings import Settings


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    """Settings of a server with two old recordings, one being written, and a profile."""
    settings = Settings(data_dir=tmp_path / "data")
    for name, content in (("recordings/day/a.h5", b"a"), ("recordings/b.h5", b"b"),
                          ("recordings/now.h5", b"n"), ("profiles/bar.toml", b"p")):  # fmt: skip
        file = settings.data_dir / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content)
        if "now" not in name:
            old = time.time() - 1000.0
            os.utime(file, (old, old))
    return settings


@pytest.fixture
def database(settings: Settings) -> Iterator[Database]:
    database = Database(settings.effective_database_url)
    migrate(database)
    yield database
    database.close()


def test_backup_holds_everything_but_what_is_written(
    database: Database, settings: Settings, tmp_path: Path
) -> None:
    made, counts = back_up_files(database, settings, tmp_path / "backups")
    found = {str(one.relative_to(made)) for one in made.rglob("*") if one.is_file()}
    assert found == {DATABASE, "recordings/day/a.h5", "recordings/b.h5", "profiles/bar.toml"}
    assert (counts["recordings"], counts["profiles"]) == (2, 1)
    assert backups_in(tmp_path / "backups") == [made]
    at = last_backup(settings.data_dir)
    assert at is not None
    assert abs(at.timestamp() - time.time()) < 60.0


def test_unchanged_files_take_their_space_once_and_old_backups_go(
    database: Database, settings: Settings, tmp_path: Path
) -> None:
    folder = tmp_path / "backups"
    first, _ = back_up_files(database, settings, folder)
    first = first.rename(folder / "20200101T000000Z")
    changed = settings.data_dir / "recordings" / "b.h5"
    changed.write_bytes(b"longer")
    os.utime(changed, (1.0, 1.0))
    second, _ = back_up_files(database, settings, folder)
    same = "recordings/day/a.h5"
    assert (first / same).stat().st_ino == (second / same).stat().st_ino
    assert (first / "recordings/b.h5").read_bytes() == b"b"
    assert (second / "recordings/b.h5").read_bytes() == b"longer"
    second = second.rename(folder / "20200102T000000Z")
    third, _ = back_up_files(database, settings, folder, keep=2)
    assert backups_in(folder) == [second, third]
    assert (second / same).read_bytes() == b"a"


def test_restore_brings_back_what_is_missing_and_replaces_nothing(
    database: Database, settings: Settings, tmp_path: Path
) -> None:
    made, _ = back_up_files(database, settings, tmp_path / "backups")
    lost = settings.data_dir / "recordings" / "day" / "a.h5"
    lost.unlink()
    changed = settings.data_dir / "profiles" / "bar.toml"
    changed.write_bytes(b"newer")
    copied, kept = restore_files(made, settings)
    assert (copied, kept) == (1, [str(changed)])
    assert lost.read_bytes() == b"a"
    assert changed.read_bytes() == b"newer"
    with pytest.raises(BackupUnusable, match="holds no database"):
        restore_files(tmp_path, settings)
