"""`lumiline bench decoder`: robustness and speed of the decoder of the line-scan protocol."""

from dataclasses import asdict
from typing import Final

from rich.table import Table

from service.cli.output import console, print_json, progress

MUTATED: Final = 1_000_000
SECONDS: Final = 2.0

CASES: Final = ((12, 8192), (16, 8192), (8, 8192), (12, 2048), (12, 512))
"""Bits of the counts, counts of a message."""


def run(*, as_json: bool) -> None:
    """Measure and print."""
    from hardware.serial.decoder_benchmark import decode_mutated, decoding_rate, stages_us

    rates = [decoding_rate(bits, counts, SECONDS) for bits, counts in CASES]
    stages = stages_us()
    with progress("mutated messages", MUTATED, quiet=as_json) as done:
        found = decode_mutated(MUTATED, 1, done)
    if as_json:
        print_json(
            {
                "rates": [asdict(rate) for rate in rates],
                "stages_us": stages,
                "mutated": asdict(found),
            }
        )
        return
    table = Table(title="decoding 4 x 2048 pixels, one core", title_justify="left")
    for column in ("counts", "MB/s", "exposures/s", "share of a core at 5 kHz"):
        table.add_column(column, justify="left" if column == "counts" else "right")
    for rate in rates:
        table.add_row(
            rate.what,
            f"{rate.megabytes_per_s:.0f}",
            f"{rate.frames_per_s:.0f}",
            f"{rate.core_share_at_5_khz:.2f}",
        )
    console.print(table)
    costs = ", ".join(f"{name} {cost:.1f}" for name, cost in stages.items())
    console.print(f"microseconds of one exposure: {costs}")
    table = Table(title=f"{found.sent} mutated messages", title_justify="left")
    table.add_column("what")
    table.add_column("number", justify="right")
    table.add_row("came out", f"{found.accepted}")
    table.add_row("of these never sent", f"{found.wrong}")
    for name, value in found.counters.items():
        table.add_row(name.replace("_", " "), f"{value}")
    table.add_row("bytes of an unfinished message kept, at most", f"{found.largest_kept}")
    table.add_row("memory, bytes", f"{found.memory_bytes}")
    console.print(table)
