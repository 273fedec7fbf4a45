"""The commands about markers: their blink codes. Options only."""

from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command("blink-codes")(blink_codes)


def blink_codes(
    markers: Annotated[int, typer.Option(min=1, max=64, help="How many markers.")] = 4,
    bits: Annotated[int, typer.Option(min=5, max=20, help="Exposures of a word.")] = 12,
    distance: Annotated[
        int, typer.Option(min=3, help="Bits in which any two differ, at least, in any phase.")
    ] = 3,
    as_json: Annotated[bool, typer.Option("--json", help="The words only.")] = False,
) -> None:
    """Make the words that markers blink, for a device's `tracking.blinking`."""
    from service.cli.blink_codes import run

    run(markers, bits, distance, as_json=as_json)
