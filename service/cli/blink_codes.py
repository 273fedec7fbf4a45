"""`lumiline blink-codes`: code words for blinking markers with a minimum distance."""

from typing import Annotated

import typer

from compute.tracking.blink_codes import blink_codes
from service.cli.options import AsJson
from service.cli.output import console, make_table, print_json


def print_codes(
    markers: Annotated[int, typer.Option(min=1, max=64, help="How many markers.")] = 4,
    bits: Annotated[int, typer.Option(min=5, max=20, help="Exposures of a word.")] = 12,
    distance: Annotated[
        int, typer.Option(min=3, help="Bits in which any two differ, at least, in any phase.")
    ] = 3,
    as_json: AsJson = False,
) -> None:
    """Print the code word of each marker."""
    codes = blink_codes(markers, bits, distance)
    if as_json:
        print_json(codes.words)
        return
    title = (
        f"{bits} bits, {codes.minimum_distance} apart in any phase: "
        f"{codes.corrected} wrong exposures of a word are corrected"
    )
    console.print(make_table(("marker", "word"), enumerate(codes.words), title, texts=None))
