"""Options of the administration commands: keys, backup, restore, check-database."""

from pathlib import Path
from typing import Annotated

import typer

keys = typer.Typer(help="Make, list and revoke API keys.", no_args_is_help=True)

DataDir = Annotated[
    Path | None, typer.Option(help="The service's data directory; left out: as `serve` takes it.")
]
AsJson = Annotated[bool, typer.Option("--json", help="For machines.")]


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.add_typer(keys, name="keys")
    app.command("backup")(backup)
    app.command("restore")(restore)
    app.command("check-database")(check_database)


@keys.command("create")
def create_key(
    name: Annotated[str, typer.Argument(help="Who or what it is for.")],
    scope: Annotated[
        list[str],
        typer.Option(
            help="read:stream, read:calibration, write:calibration, admin:hardware, admin:keys; "
            "may be given several times. all: every one."
        ),
    ],
    days: Annotated[
        float | None,
        typer.Option(min=0.001, max=36_525, help="Valid so long; left out: until revoked."),
    ] = None,
    data_dir: DataDir = None,
) -> None:
    """Make a key, and print it once: it is kept nowhere."""
    from service.cli.keys import create

    create(data_dir, name, scope, days)


@keys.command("list")
def list_keys(data_dir: DataDir = None, as_json: AsJson = False) -> None:
    """List the keys that were given out."""
    from service.cli.keys import show

    show(data_dir, as_json=as_json)


@keys.command("revoke")
def revoke_key(
    key: Annotated[str, typer.Argument(help="Its id: the part between lumi_ and the secret.")],
    data_dir: DataDir = None,
) -> None:
    """Take a key back for good; its open streams end within seconds."""
    from service.cli.keys import revoke

    revoke(data_dir, key)


def backup(
    file: Annotated[Path, typer.Argument(help="The file to write.")],
    data_dir: DataDir = None,
) -> None:
    """Write all that the database holds into one file, while the service runs."""
    from service.cli.backup import run_backup

    run_backup(data_dir, file)


def restore(
    file: Annotated[Path, typer.Argument(help="A file that `lumiline backup` wrote.")],
    replace: Annotated[
        bool, typer.Option("--replace", help="Replace what is there, after backing it up.")
    ] = False,
    data_dir: DataDir = None,
) -> None:
    """Put a backup's content into the database, SQLite or PostgreSQL. Stop the service first."""
    from service.cli.backup import run_restore

    run_restore(data_dir, file, replace=replace)


def check_database(data_dir: DataDir = None) -> None:
    """Check hashes, references and history of what the database holds."""
    from service.cli.backup import run_check

    run_check(data_dir)
