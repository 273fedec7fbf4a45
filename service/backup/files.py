"""Backups of a whole server: database, recordings and profiles in a folder for each."""

import json
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from service.backup.backup import back_up
from service.database.engine import Database
from service.problems.errors import BackupUnusable
from service.settings import Settings

DATABASE: Final = "database.lumiline"
FOLDERS: Final = ("recordings", "profiles")
LAST_BACKUP: Final = "last-backup.json"
"""File of the data directory that says when the last whole backup was made."""
WRITTEN_S: Final = 60.0
"""A file that changed within this time may still be written: the next backup has it."""
_NAME: Final = "%Y%m%dT%H%M%SZ"
_NOTHING_TOLD: Final = (OSError, ValueError, KeyError, TypeError)
"""There was no backup, or its file is damaged."""


def back_up_files(
    database: Database,
    settings: Settings,
    folder: Path,
    keep: int | None = None,
) -> tuple[Path, dict[str, int]]:
    """Write a backup into a new folder inside one; return it, and what it holds.

    It has its name only when it is whole. Files that are as in the newest earlier backup are hard
    links to that one's, so that recordings take their space once. A recording that is being
    written is left out, and so is one that is deleted meanwhile.

    Args:
        database: the server's.
        settings: its settings, which say where recordings and profiles are.
        folder: where backups are kept.
        keep: backups that are left; older ones are deleted; None: all.

    Raises:
        OSError: it cannot be written.
        DatabaseDamaged: as ``back_up``.
    """
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    now = datetime.now(UTC)
    earlier = backups_in(folder)
    final = folder / now.strftime(_NAME)
    if final.exists():
        raise FileExistsError(f"{final} exists already; wait a second")
    with tempfile.TemporaryDirectory(prefix=".part-", dir=folder) as temporary:
        copy = Path(temporary) / "backup"
        counts = back_up(database, copy / DATABASE)
        sources = (settings.folders.recordings, settings.folders.profiles)
        for name, source in zip(FOLDERS, sources, strict=True):
            before = earlier[-1] / name if earlier else None
            counts[name] = _copy_tree(source, copy / name, before)
        copy.rename(final)
    _write_last(settings.data_dir, final, now)
    if keep is not None:
        for old in backups_in(folder)[:-keep]:
            shutil.rmtree(old)
    return final, counts


def backups_in(folder: Path) -> list[Path]:
    """Return the whole backups in a folder, the oldest first."""
    return sorted(one for one in folder.iterdir() if (one / DATABASE).is_file())


def restore_files(backup: Path, settings: Settings) -> tuple[int, list[str]]:
    """Copy a backup's recordings and profiles back.

    Returns:
        How many files were copied, and the names of those that differ from files that are there:
        these stay as they are.

    Raises:
        BackupUnusable: the folder holds no backup.
    """
    if not (backup / DATABASE).is_file():
        raise BackupUnusable(f"{backup} holds no {DATABASE}; give the folder of one backup")
    copied, skipped = 0, []
    for name, target in zip(
        FOLDERS, (settings.folders.recordings, settings.folders.profiles), strict=True
    ):
        for path in _files(backup / name):
            there = target / path.relative_to(backup / name)
            if not there.exists():
                there.parent.mkdir(parents=True, exist_ok=True)
                part = there.with_name(f"{there.name}.part")
                shutil.copy2(path, part)
                part.replace(there)
                copied += 1
            elif not _is_same(path, there):
                skipped.append(str(there))
    return copied, skipped


def last_backup(data_dir: Path) -> datetime | None:
    """Return when the last whole backup was made; None: never, or it cannot be told."""
    try:
        return datetime.fromisoformat(_last_written(data_dir)["at"])
    except _NOTHING_TOLD:
        return None


def backups_beside_last(data_dir: Path) -> list[Path]:
    """Return the whole backups in the folder of the last one, the oldest first.

    Empty where there was none, or the folder cannot be read.
    """
    try:
        folder = Path(_last_written(data_dir)["backup"]).parent
        return [one for one in backups_in(folder) if _is_named(one)]
    except _NOTHING_TOLD:
        return []


def backup_time(backup: Path) -> datetime:
    """Return when a backup was made, as its name says."""
    return datetime.strptime(backup.name, _NAME).replace(tzinfo=UTC)


def _is_named(backup: Path) -> bool:
    try:
        backup_time(backup)
    except ValueError:
        return False  # somebody renamed it
    return True


def _last_written(data_dir: Path) -> Any:
    """Return what was written of the last whole backup; raises what _NOTHING_TOLD lists."""
    return json.loads((data_dir / LAST_BACKUP).read_text(encoding="utf-8"))


def _write_last(data_dir: Path, backup: Path, at: datetime) -> None:
    file = data_dir / LAST_BACKUP
    part = file.with_name(f"{file.name}.part")
    part.write_text(json.dumps({"at": at.isoformat(), "backup": str(backup)}), encoding="utf-8")
    part.replace(file)


def _copy_tree(source: Path, target: Path, before: Path | None) -> int:
    """Copy a folder's files, by links where they have not changed; return how many.

    A file that is deleted or changed meanwhile is left out.
    """
    target.mkdir(mode=0o700)
    count = 0
    for path in _files(source):
        name = path.relative_to(source)
        copy = target / name
        previous = None if before is None else before / name
        try:
            # The time of a file's change may lie ahead: the clock was set back, or its maker's is.
            status = path.stat()
            if abs(time.time() - status.st_mtime) < WRITTEN_S:
                continue
            copy.parent.mkdir(parents=True, exist_ok=True)
            if previous is not None and previous.is_file() and _is_same(path, previous):
                os.link(previous, copy)
            else:
                shutil.copy2(path, copy)
            unchanged = _state(path.stat()) == _state(status)
        except FileNotFoundError:
            if path.exists():
                raise
            unchanged = False
        if unchanged:
            count += 1
        else:
            copy.unlink(missing_ok=True)
    return count


def _files(folder: Path) -> Iterator[Path]:
    """Yield the files below a folder; one that is deleted meanwhile is left out."""

    def refuse(error: OSError) -> None:
        if not isinstance(error, FileNotFoundError):
            raise error

    for where, folders, names in os.walk(folder, onerror=refuse):
        folders.sort()
        yield from (one for name in sorted(names) if (one := Path(where, name)).is_file())


def _is_same(one: Path, other: Path) -> bool:
    """Whether two files have the same size and time of change, as copies keep it."""
    return _state(one.stat()) == _state(other.stat())


def _state(status: os.stat_result) -> tuple[int, int]:
    return status.st_size, status.st_mtime_ns
