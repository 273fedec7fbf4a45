"""`lumiline bench decoder`: robustness and speed of the decoder of the line-scan protocol."""

from dataclasses import asdict
from typing import Any, Final

from service.cli.output import console, make_table, print_json, progress

MUTATED: Final = 1_000_000
SECONDS: Final = 2.0

CASES: Final = ((12, 8192), (16, 8192), (8, 8192), (12, 2048), (12, 512))
"""Bits of the counts, counts of a message."""


def run(*, as_json: bool, **_: Any) -> None:
    """Measure and print."""
    from hardware.serial.decoder_benchmark import decode_mutated, decoding_rate, stages_us

    rates = [decoding_rate(bits, counts, SECONDS) for bits, counts in CASES]
    stages = stages_us()
    with progress("mutated messages", MUTATED, quiet=as_json) as report:
        mutated = decode_mutated(MUTATED, 1, report)
    if as_json:
        figures = {"rates": list(map(asdict, rates)), "stages_us": stages}
        print_json(figures | {"mutated": asdict(mutated)})
        return
    headings = ("counts", "MB/s", "exposures/s", "share of a core at 5 kHz")
    speeds = (
        (rate.what, f"{rate.megabytes_per_s:.0f}", f"{rate.frames_per_s:.0f}",
         f"{rate.core_share_at_5_khz:.2f}")
        for rate in rates
    )  # fmt: skip
    console.print(make_table(headings, speeds, "decoding 4 x 2048 pixels, one core"))
    costs = ", ".join(f"{name} {cost:.1f}" for name, cost in stages.items())
    console.print(f"microseconds of one exposure: {costs}")
    rows = [
        ("came out", mutated.accepted),
        ("of these never sent", mutated.wrong),
        *((name.replace("_", " "), value) for name, value in mutated.counters.items()),
        ("bytes of an unfinished message kept, at most", mutated.largest_kept),
        ("memory, bytes", mutated.memory_bytes),
    ]
    console.print(make_table(("what", "number"), rows, f"{mutated.sent} mutated messages"))
