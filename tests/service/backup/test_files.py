"""Backups of database, recordings and profiles together."""

import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

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


def test_backup_file_changed_in_the_future_is_copied_once(
    database: Database, settings: Settings, tmp_path: Path
) -> None:
    ahead = time.time() + 1e6
    os.utime(settings.data_dir / "recordings" / "b.h5", (ahead, ahead))
    first, counts = back_up_files(database, settings, tmp_path / "backups")
    assert counts["recordings"] == 2
    first = first.rename(tmp_path / "backups" / "20200101T000000Z")
    second, _ = back_up_files(database, settings, tmp_path / "backups")
    inodes = {(one / "recordings" / "b.h5").stat().st_ino for one in (first, second)}
    assert len(inodes) == 1


@pytest.mark.parametrize("moment", ["before", "meanwhile", "changed"])
def test_backup_file_deleted_or_changed_meanwhile_is_left_out(
    database: Database,
    settings: Settings,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    moment: str,
) -> None:
    gone, copy2 = settings.data_dir / "recordings" / "day" / "a.h5", shutil.copy2

    def deleting(source: Path, target: Path) -> None:
        if source == gone and moment == "before":
            gone.unlink()
        copy2(source, target)
        if source == gone:
            gone.unlink()
            if moment == "changed":
                gone.write_bytes(b"longer")

    monkeypatch.setattr(shutil, "copy2", deleting)
    made, counts = back_up_files(database, settings, tmp_path / "backups")
    assert counts["recordings"] == 1
    files = [one.name for one in (made / "recordings").rglob("*.h5")]
    assert files == ["b.h5"]


def test_backup_folder_deleted_meanwhile_is_left_out(
    database: Database, settings: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, scandir = str(settings.data_dir / "recordings" / "day"), os.scandir

    def deleting(path: str) -> Any:
        if str(path) == folder and Path(folder).exists():
            shutil.rmtree(folder)
        return scandir(path)

    monkeypatch.setattr(os, "scandir", deleting)
    _, counts = back_up_files(database, settings, tmp_path / "backups")
    assert counts["recordings"] == 1


def test_backup_that_cannot_be_written_raises(
    database: Database, settings: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(source: Path, target: Path) -> None:
        raise FileNotFoundError(str(target))

    monkeypatch.setattr(shutil, "copy2", missing)
    with pytest.raises(FileNotFoundError):
        back_up_files(database, settings, tmp_path / "backups")
    assert backups_in(tmp_path / "backups") == []


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
