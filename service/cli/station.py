"""`lumiline station`: owns the devices of one machine, for servers on others."""

from contextlib import closing
from pathlib import Path
from typing import Annotated

import typer

from service.cli.options import ComputeDevice
from service.cli.serve import load_settings, set_private_umask


def station(
    name: Annotated[
        str | None, typer.Option(help="The station's name, as devices have it.")
    ] = None,
    data_dir: Annotated[Path | None, typer.Option(help="Recordings to replay, profiles.")] = None,
    compute_device: ComputeDevice = None,
) -> None:
    """Run until interrupted; ends the command with one line when it cannot start."""
    set_private_umask()
    settings = load_settings(station_name=name, data_dir=data_dir, compute_device=compute_device)
    for setting, value, what in (
        ("station_name", settings.station_name, "what the station is called"),
        ("bus_url", settings.bus_url, "where NATS is, such as nats://broker:4222"),
    ):
        if value is None:
            typer.echo(
                f"setting {setting}: a station needs it, {what}; give LUMILINE_{setting.upper()}",
                err=True,
            )
            raise typer.Exit(2)
    if settings.station != "process":
        typer.echo(
            f"setting station: {settings.station} is for servers; a station is a process", err=True
        )
        raise typer.Exit(2)
    from service.station.station_starter import StationStarter

    with closing(StationStarter()) as starter:
        # It loads what a station needs while this process loads the rest.
        starter.launch()
        from service.application.station_host import run_station
        from service.cli import preflight
        from service.logs import configured_logging

        preflight.open_database(settings.effective_database_url).close()
        settings.folders.recordings.mkdir(parents=True, exist_ok=True)
        with configured_logging(settings):
            run_station(settings, starter)
