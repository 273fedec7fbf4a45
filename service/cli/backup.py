"""`lumiline backup`, `restore` and `check-database`."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from service.backup import backup as whole_backup
from service.backup import restore as restoration
from service.backup.consistency import find_inconsistencies
from service.backup.copy_rows import count_rows
from service.backup.files import DATABASE, back_up_files, restore_files
from service.cli.local_database import DataDir, local_database
from service.cli.options import AsJson, Force, refuse_unused
from service.cli.output import atomic_file, check_folder, check_output, print_json, progress, say


def backup(
    context: typer.Context,
    file: Annotated[Path, typer.Argument(help="The file to write; with --files, the folder.")],
    files: Annotated[
        bool, typer.Option("--files", help="With recordings and profiles, in a new folder inside.")
    ] = False,
    keep: Annotated[
        int | None, typer.Option(min=1, help="Of --files: delete all but this many backups.")
    ] = None,
    data_dir: DataDir = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Write a backup and say what it holds."""
    if files:
        refuse_unused(context, "with --files, which makes a folder for each backup", "force")
        check_folder(file)
    else:
        refuse_unused(context, "without --files, which makes a folder for each backup", "keep")
        check_output(file, force=force)
    with (
        local_database(data_dir, "backup") as (database, settings),
        progress(f"writing {escape(str(file))}", quiet=as_json),
    ):
        database.check()
        if files:
            file, counts = back_up_files(database, settings, file, keep)
        else:
            with atomic_file(file) as temporary:
                counts = whole_backup.back_up(database, temporary)
    if as_json:
        print_json({"file": str(file), "rows": counts})
    else:
        say(f"{escape(str(file))}: {_to_sentence(counts)}")


def restore(
    file: Annotated[Path, typer.Argument(help="A file that `lumiline backup` wrote.")],
    replace: Annotated[
        bool, typer.Option("--replace", help="Replace what is there, after backing it up.")
    ] = False,
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """Restore a backup and say what was done."""
    folder = file if file.is_dir() else None
    file = file if folder is None else folder / DATABASE
    with (
        local_database(data_dir, "restore") as (database, settings),
        progress(f"reading {escape(str(file))}", quiet=as_json),
    ):
        settings.folders.recordings.mkdir(parents=True, exist_ok=True)
        keep_in = settings.data_dir / "backups" if replace else None
        restored = restoration.restore(database, file, keep_in)
        copied, skipped = (0, []) if folder is None else restore_files(folder, settings)
    if as_json:
        print_json({
            "rows": restored.counts,
            "previous": None if restored.previous is None else str(restored.previous),
            "files_copied": copied,
            "files_that_differ": skipped,
            "keys": asdict(restored.keys),
        })  # fmt: skip
        return
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


def check_database(data_dir: DataDir = None, as_json: AsJson = False) -> None:
    """Print what is wrong with the database; ends with 1 when anything is."""
    with (
        local_database(data_dir, "check-database") as (database, _),
        database.engine.connect() as connection,
        progress("checking", quiet=as_json),
    ):
        inconsistencies = find_inconsistencies(connection)
        counts = {} if inconsistencies else count_rows(connection)
    if as_json:
        print_json({"inconsistencies": list(inconsistencies), "rows": counts})
    for line in () if as_json else inconsistencies:
        typer.echo(line)
    if inconsistencies:
        raise typer.Exit(1)
    if not as_json:
        say(f"sound: {_to_sentence(counts)}")


def _to_sentence(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.items() if count)
