"""The command line `lumiline`: one command per job, each in its own module of this package.

The modules `*_commands` have the options. What a command does is imported when it runs, so that
`lumiline --help` stays quick.
"""

from typing import Annotated

import typer

from service.cli import (
    administration_commands,
    beam_hold_commands,
    calibration_commands,
    laboratory_commands,
    recording_commands,
    server_commands,
    tools_commands,
)
from service.version import DISCLAIMER, package_version

app = typer.Typer(
    name="lumiline",
    help="Tracking server for linear (1D) optical sensors.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_show_locals=False,
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"{package_version()}\n{DISCLAIMER}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="Print the version."),
    ] = False,
) -> None:
    """Tracking server for linear (1D) optical sensors."""


for _commands in (
    server_commands,
    calibration_commands,
    recording_commands,
    laboratory_commands,
    administration_commands,
    tools_commands,
    beam_hold_commands,
):
    _commands.register(app)


def main() -> None:
    """Run the command line."""
    app()
