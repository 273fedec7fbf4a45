"""`lumiline bench stalled-clients`: latencies of good clients beside 100 that never read."""

import asyncio
from pathlib import Path
from statistics import median
from typing import Any, Final

from service.cli.bench_service import DEVICE, Figures, run_benchmark
from service.cli.output import console, fail, make_table, progress
from service.cli.service_process import service_process

TITLE: Final = "ten clients of a stream at 1 kHz, without and with 100 others that never read"
GOOD: Final = 10
STALLED: Final = 100
ROUNDS: Final = 3
MIN_SECONDS: Final = 20.0
"""Less leaves no time in a round after the stalled ones' buffers are full."""


def run(*, seconds: float, as_json: bool, **_: Any) -> None:
    """Measure without and with stalled clients in turn, and print the latencies of the good ones.

    Args:
        seconds: of all rounds together.
        as_json: whether JSON is printed.

    Raises:
        typer.Exit: that is too short.
    """
    if seconds < MIN_SECONDS:
        raise fail(
            f"{seconds:g} s are too short for {2 * ROUNDS} rounds of stalled-clients: the buffers "
            f"of clients that do not read are full after some seconds; at least {MIN_SECONDS:g}"
        )
    run_benchmark(
        lambda folder: _measure(folder, seconds / (2 * ROUNDS), quiet=as_json),
        _show,
        as_json=as_json,
    )


def _measure(folder: Path, seconds: float, *, quiet: bool) -> Figures:
    from benchmarks.stalled_clients import measure

    with (
        service_process(folder / "service", quiet=quiet) as service,
        progress(TITLE, quiet=quiet),
    ):
        rounds = [
            asyncio.run(measure(service.url, f"device_id={DEVICE}", seconds, GOOD, stalled))
            for _ in range(ROUNDS)
            for stalled in (0, STALLED)
        ]
    return {
        "rounds": rounds,
        "p99_ratio": _p99_ratio(rounds, "frame_ms"),
        "p99_ratio_settled": _p99_ratio(rounds, "settled_ms"),
    }


def _p99_ratio(rounds: list[Any], name: str) -> float:
    p99: dict[int, float] = {
        stalled: median(one[name]["p99"] for one in rounds if one["stalled"] == stalled)
        for stalled in (0, STALLED)
    }
    return p99[STALLED] / p99[0]


def _show(figures: Figures) -> None:
    headings = (
        *("stalled", "frames received"),
        *("median, ms", "p99, ms", "most, ms", "p99 later, ms", "most later, ms"),
        *("/healthz p99, ms", "/healthz most, ms"),
    )
    rows = [
        (
            one["stalled"],
            one["frames"],
            *(f"{one['frame_ms'][name]:.1f}" for name in ("p50", "p99", "max")),
            *(f"{one['settled_ms'][name]:.1f}" for name in ("p99", "max")),
            *(f"{one['healthz_ms'][name]:.1f}" for name in ("p99", "max")),
        )
        for one in figures["rounds"]
    ]
    console.print(make_table(headings, rows, TITLE))
    console.print(
        f"p99 with stalled clients over p99 without, medians of {ROUNDS} rounds: "
        f"{figures['p99_ratio']:.2f}, and {figures['p99_ratio_settled']:.2f} later: the stalled "
        "ones connect at once, after a tenth of a round, and two seconds later their buffers are "
        "full."
    )
