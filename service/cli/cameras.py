"""`lumiline cameras`: lists the GenICam cameras that can be opened from here."""

import typer
from rich.table import Table

from compute.errors import LumilineError
from hardware.genicam.camera import DiscoveredCamera, cameras
from service.cli.output import console, fail, print_json


def run(*, as_json: bool) -> None:
    """List the cameras."""
    try:
        found = cameras()
    except LumilineError as error:
        raise fail(error.detail) from error
    if as_json:
        print_json(found)
    elif found:
        console.print(_table(found))
    else:
        typer.echo(
            "No camera answered. Check cables, power, and that addresses are of one network."
        )


def _table(found: list[DiscoveredCamera]) -> Table:
    table = Table(title="GenICam cameras")
    for heading in ("camera", "address", "vendor", "model", "serial number", "protocol"):
        table.add_column(heading, overflow="fold")
    for entry in found:
        table.add_row(
            entry.camera,
            entry.address,
            entry.vendor,
            entry.model,
            entry.serial_number,
            entry.protocol,
        )
    return table
