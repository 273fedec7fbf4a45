"""`lumiline blink-codes`: code words for blinking markers with a minimum distance."""

from rich.table import Table

from compute.errors import LumilineError
from compute.tracking.blink_codes import blink_codes
from service.cli.output import console, fail, print_json


def run(markers: int, bits: int, distance: int, *, as_json: bool) -> None:
    """Print the code word of each marker."""
    try:
        codes = blink_codes(markers, bits, distance)
    except LumilineError as error:
        raise fail(error.detail) from error
    if as_json:
        print_json(list(codes.words))
        return
    table = Table(
        title=f"{bits} bits, {codes.minimum_distance} apart in any phase: "
        f"{codes.corrected} wrong exposures of a word are corrected"
    )
    table.add_column("marker", justify="right")
    table.add_column("word")
    for marker, word in enumerate(codes.words):
        table.add_row(str(marker), word)
    console.print(table)
