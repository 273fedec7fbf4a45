"""`lumiline backup`, `restore` and `check-database`."""

from collections.abc import Iterator
from pathlib import Path

import typer

from service.backup.backup import back_up
from service.backup.consistency import find_inconsistencies
from service.backup.copy_rows import count_rows
from service.backup.restore import KeyChanges, restore
from service.cli.local_database import local_database
from service.cli.output import console, progress


def run_backup(data_dir: Path | None, file: Path) -> None:
    """Write a backup and say what it holds."""
    with local_database(data_dir, "backup") as (database, _), progress(f"writing {file}"):
        database.check()
        counts = back_up(database, file)
    console.print(f"{file}: {_to_sentence(counts)}", highlight=False)


def run_restore(data_dir: Path | None, file: Path, *, replace: bool) -> None:
    """Restore a backup and say what was done."""
    with local_database(data_dir, "restore") as (database, settings), progress(f"reading {file}"):
        settings.folders.recordings.mkdir(parents=True, exist_ok=True)
        keep_in = settings.data_dir / "backups" if replace else None
        restored = restore(database, file, keep_in)
    if restored.kept is not None:
        console.print(f"what was there is in {restored.kept}", highlight=False)
    console.print(f"restored: {_to_sentence(restored.counts)}", highlight=False)
    for line in _of_keys(restored.keys):
        console.print(line, highlight=False)


def run_check(data_dir: Path | None) -> None:
    """Print what is wrong with the database; ends with 1 when anything is."""
    with (
        local_database(data_dir, "check-database") as (database, _),
        database.engine.connect() as connection,
    ):
        found = find_inconsistencies(connection)
        counts = None if found else count_rows(connection)
    for line in found:
        typer.echo(line)
    if counts is None:
        raise typer.Exit(1)
    console.print(f"sound: {_to_sentence(counts)}", highlight=False)


def _of_keys(keys: KeyChanges) -> Iterator[str]:
    for found, what in (
        (keys.revoked, "valid in the backup, and stay revoked"),
        (keys.valid, "valid now, and were not before; revoke those that should not be"),
        (keys.lost, "not in the backup, and can be used no more"),
    ):
        if found:
            yield f"keys {', '.join(found)}: {what}"


def _to_sentence(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.items() if count)
