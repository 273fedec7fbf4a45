"""`lumiline bench hostile-bodies`: stalls of good clients while hostile bodies are sent."""

import asyncio
from pathlib import Path
from typing import Any, Final

from service.cli.bench_service import DEVICE, Figures, run_benchmark
from service.cli.output import console, make_table, progress
from service.cli.server_session import client_session
from service.cli.service_process import free_port, service_process

TITLE: Final = "bodies by each scope, beside a websocket client, an OpenIGTLink client and /healthz"
AT_ONCE: Final = (1, 4)
"""Clients that send the same body at the same time."""
HOLD: Final = "patient"


def run(*, as_json: bool, **_: Any) -> None:
    """Send each body, and print how long others waited."""
    run_benchmark(lambda folder: _measure(folder, quiet=as_json), _show, as_json=as_json)


def _measure(folder: Path, *, quiet: bool) -> Figures:
    from benchmarks.hostile_bodies import measure

    port = free_port()
    settings = {"openigtlink_port": str(port)}
    with service_process(folder / "service", settings, quiet=quiet) as service:
        with client_session(service.url, None, 60.0) as client:
            client.create_beam_hold(
                id=HOLD,
                device_id=DEVICE,
                title="Hostile bodies",
                watch={"kind": "strobed-markers", "markers": [0]},
                limits={"shift_mm": 2.0},
            )
        with progress(TITLE, quiet=quiet):
            return {
                f"{count} at once": asyncio.run(
                    measure(service.url, port, count, pid=service.pid)
                )
                for count in AT_ONCE
            }  # fmt: skip


def _show(figures: Figures) -> None:
    headings = (
        *("body", "scope", "path", "answer", "bytes", "seconds"),
        *("/healthz max, ms", "frame gap, ms", "status gap, ms", "memory, MiB"),
    )
    for title, timings in figures.items():
        rows = [
            (
                *(one["body"], one.get("scope"), one.get("path")),
                " ".join(map(str, one.get("statuses", ()))),
                one.get("answer_bytes"),
                f"{one['seconds']:.1f}" if "seconds" in one else None,
                *(
                    None if value is None else f"{value:.0f}"
                    for value in (
                        one["healthz_ms"].get("max"), one["frame_gap_ms"], one["status_gap_ms"]
                    )
                ),
                None if one["memory_bytes"] is None else f"{one['memory_bytes'] / 2**20:.0f}",
            )
            for one in timings
        ]  # fmt: skip
        console.print(make_table(headings, rows, f"{TITLE}, {title}"))
    console.print(
        "gap: the longest time without a message of the stream, or without a status of the hold, "
        "which is repeated each second. memory: of the service and its processes, after the body."
    )
