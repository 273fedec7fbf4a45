"""`lumiline backup`, `restore` and `check-database`."""

from pathlib import Path
from typing import Annotated

import typer

from service.backup import backup as whole_backup
from service.backup import restore as restoration
from service.backup.consistency import find_inconsistencies
from service.backup.copy_rows import count_rows
from service.backup.files import DATABASE, back_up_files, restore_files
from service.cli.local_database import DataDir, local_database
from service.cli.output import fail, progress, say


def backup(
    file: Annotated[Path, typer.Argument(help="The file to write; with --files, the folder.")],
    files: Annotated[
        bool, typer.Option("--files", help="With recordings and profiles, in a new folder inside.")
    ] = False,
    keep: Annotated[
        int | None, typer.Option(min=1, help="Of --files: delete all but this many backups.")
    ] = None,
    data_dir: DataDir = None,
) -> None:
    """Write a backup and say what it holds."""
    if files:
        _back_up_files(file, keep, data_dir)
        return
    if keep is not None:
        raise fail("--keep is of --files, which makes a folder for each backup")
    with local_database(data_dir, "backup") as (database, _), progress(f"writing {file}"):
        database.check()
        counts = whole_backup.back_up(database, file)
    say(f"{file}: {_to_sentence(counts)}")


def restore(
    file: Annotated[Path, typer.Argument(help="A file that `lumiline backup` wrote.")],
    replace: Annotated[
        bool, typer.Option("--replace", help="Replace what is there, after backing it up.")
    ] = False,
    data_dir: DataDir = None,
) -> None:
    """Restore a backup and say what was done."""
    folder = file if file.is_dir() else None
    file = file if folder is None else folder / DATABASE
    with local_database(data_dir, "restore") as (database, settings), progress(f"reading {file}"):
        settings.folders.recordings.mkdir(parents=True, exist_ok=True)
        keep_in = settings.data_dir / "backups" if replace else None
        restored = restoration.restore(database, file, keep_in)
        copied, skipped = (0, []) if folder is None else restore_files(folder, settings)
    if restored.previous is not None:
        say(f"what was there is in {restored.previous}")
    say(f"restored: {_to_sentence(restored.counts)}")
    if folder is not None:
        say(f"files copied: {copied}")
    for name in skipped:
        say(f"{name} differs from the backup's, and stays as it is")
    for keys, what in (
        (restored.keys.revoked, "valid in the backup, and stay revoked"),
        (restored.keys.valid, "valid now, and were not before; revoke those that should not be"),
        (restored.keys.lost, "not in the backup, and can be used no more"),
    ):
        if keys:
            say(f"keys {', '.join(keys)}: {what}")


def _back_up_files(folder: Path, keep: int | None, data_dir: Path | None) -> None:
    with (
        local_database(data_dir, "backup") as (database, settings),
        progress(f"writing into {folder}"),
    ):
        database.check()
        folder_written, counts = back_up_files(database, settings, folder, keep)
    say(f"{folder_written}: {_to_sentence(counts)}")


def check_database(data_dir: DataDir = None) -> None:
    """Print what is wrong with the database; ends with 1 when anything is."""
    with (
        local_database(data_dir, "check-database") as (database, _),
        database.engine.connect() as connection,
    ):
        inconsistencies = find_inconsistencies(connection)
        counts = {} if inconsistencies else count_rows(connection)
    for line in inconsistencies:
        typer.echo(line)
    if inconsistencies:
        raise typer.Exit(1)
    say(f"sound: {_to_sentence(counts)}")


def _to_sentence(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.items() if count)
