"""`lumiline cameras`: lists the GenICam cameras that can be opened from here."""

from dataclasses import astuple

import typer

from hardware.genicam.camera import cameras
from service.cli.options import AsJson
from service.cli.output import console, make_table, print_json


def list_cameras(as_json: AsJson = False) -> None:
    """List the cameras."""
    listed = cameras()
    if as_json:
        print_json(listed)
    elif listed:
        headings = ("camera", "address", "vendor", "model", "serial number", "protocol")
        console.print(make_table(headings, map(astuple, listed), "GenICam cameras", texts=None))
    else:
        typer.echo(
            "No camera answered. Check cables, power, and that addresses are of one network."
        )
