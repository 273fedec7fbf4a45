"""The command line `lumiline`: each command, with its options, is in a module of this package."""

import os
from importlib import import_module
from typing import Annotated, Any, Final

import typer
from typer.core import TyperCommand, TyperGroup

from compute.errors import LumilineError
from service.cli.output import fail
from service.jobs.worker import THREAD_VARIABLES
from service.version import DISCLAIMER, package_version

_COMMANDS: Final = (
    ("serve", "serve:serve",
     "Run the service. Options win over LUMILINE_... variables and lumiline.toml."),
    ("openapi", "serve:openapi", "Print the OpenAPI document."),
    ("demo", "demo:demo",
     "Show the main job end to end: a real service, measured frames, a simulated device."),
    ("station", "station:station",
     "Own the devices of one machine, for servers on others: needs NATS and PostgreSQL."),
    ("examples", "examples:examples",
     "Write small files to try the commands with: a waved wand, a volume, cameras, a profile."),
    ("reproduce", "reproduce:reproduce",
     "Run published tests: the reference figures and ours side by side. No case: list them."),
    ("bench", "bench:bench",
     "Measure speed beside the peers a user would pick instead. No name: list them."),
    ("calibrate", "calibrate:calibrate",
     "Calibrate from a CSV file of control points and readings, without a server."),
    ("wand", "wand:wand",
     "Calibrate from a wand waved through the volume: no known coordinates, one known length."),
    ("map", "map_volume:map_volume",
     "Map a volume: corrections of the readings where the calibrated cameras are wrong."),
    ("radiometric-calibration", "radiometric_calibration:radiometric_calibration",
     "Calibrate the pixels of sensors: offset, response, noise, bad pixels (EMVA 1288)."),
    ("drift", "drift:drift",
     "Check whether a calibration still holds; exit code 1 where it does not. Quickly update it."),
    ("record", "record:record",
     "Record the simulated bar, or a profile's device, with its calibration, to a file."),
    ("replay", "replay:replay",
     "Reconstruct a recording: one JSON message a frame, as the stream sends them."),
    ("readings", "readings:readings",
     "Write the readings of a recording as CSV, for calibrate, wand, map and drift."),
    ("export", "export:export",
     "Write points, tracks and tool poses for other programs: C3D, TRC, CSV, Parquet, PLUS."),
    ("simulate-serial", "simulate_serial:simulate_serial",
     "Be a device that speaks the line-scan protocol, in a process of its own."),
    ("cameras", "cameras:list_cameras",
     "List the GenICam cameras that can be seen from here; needs the library Aravis."),
    ("plan", "plan:plan",
     "Work out what a device will reach: precision, coverage, rates, ghosts. No name: list them."),
    ("peaks", "peaks:peaks",
     "Find the peaks of line scans. Noise that is not given is guessed, or the recording's."),
    ("blink-codes", "blink_codes:print_codes",
     "Make the words that markers blink, for a device's `tracking.blinking`."),
    ("backup", "backup:backup",
     "Write all that the database holds into one file, while the service runs."),
    ("restore", "backup:restore",
     "Put a backup's content into the database, SQLite or PostgreSQL. Stop the service first."),
    ("check-database", "backup:check_database",
     "Check hashes, references and history of what the database holds."),
    ("keys", "keys:keys", "Make, list and revoke API keys."),
    ("tools", "tools:tools", "Tools of a running server, and where they are."),
    ("beam-holds", "beam_holds:holds",
     "Beam holds of a running server, and whether a beam is held."),
)  # fmt: skip
"""Name, ``module:function`` or ``module:typer.Typer``, and help of each command."""


class LazyCommand(TyperCommand):
    """A command whose module is imported when it runs, so that `lumiline --help` stays quick."""

    def __init__(self, name: str, target: str, help: str) -> None:  # noqa: A002
        super().__init__(name, help=help)
        self._target = target

    def load(self) -> Any:
        """Import the command, and return it as Typer runs it."""
        module, _, attribute = self._target.partition(":")
        target = getattr(import_module(f"service.cli.{module}"), attribute)
        if not isinstance(target, typer.Typer):
            function, target = target, typer.Typer(add_completion=False)
            target.command(self.name, help=self.help)(function)
        return typer.main.get_command(target)

    def make_context(self, *args: Any, **named: Any) -> Any:
        """Return the context of the imported command."""
        return self.load().make_context(*args, **named)


class Commands(TyperGroup):
    """All commands; an error of the domain ends the command with its detail."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        self.commands = {row[0]: LazyCommand(*row) for row in _COMMANDS}

    def invoke(self, ctx: Any) -> Any:
        """Run a command."""
        try:
            return super().invoke(ctx)
        except LumilineError as error:
            raise fail(error.detail) from error


app = typer.Typer(
    name="lumiline",
    cls=Commands,
    help="Tracking server for linear (1D) optical sensors.",
    no_args_is_help=True,
    pretty_exceptions_show_locals=False,
)


def _version(requested: bool) -> None:
    if requested:
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


def main() -> None:
    """Run the command line, its linear algebra in one thread unless the environment says otherwise.

    On busy cores the threads of a BLAS wait for each other: small systems took eight times as long.
    """
    for name in THREAD_VARIABLES:
        os.environ.setdefault(name, "1")
    app()
