"""`lumiline bench live`: the live pipeline to one websocket client."""

from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from service.cli.bench_service import Figures, measure_baseline_stream, run_benchmark
from service.cli.output import console, make_table, progress
from service.cli.service_process import service_process

TITLE: Final = "the live pipeline: 4 sensors x 2048 pixels at 1 kHz to one websocket client"


def run(*, seconds: float, as_json: bool, **_: Any) -> None:
    """Measure, and print the figures beside those of a bare websocket."""
    run_benchmark(lambda folder: _measure(folder, seconds, quiet=as_json), _show, as_json=as_json)


def _measure(folder: Path, seconds: float, *, quiet: bool) -> Figures:
    from benchmarks.live import measure

    with service_process(folder, quiet=quiet) as service:
        stream = f"{service.stream_url}?device_id=sim"
        with progress("streaming", seconds, quiet=quiet) as report:
            figures = measure(stream, seconds, report)
    bare = measure_baseline_stream(quiet=quiet)
    return {"live": asdict(figures), "baseline_websocket": asdict(bare)}


def _show(figures: Figures) -> None:
    ours, bare = figures["live"], figures["baseline_websocket"]
    rows: list[tuple[object, ...]] = [
        ("duration, s", f"{ours['seconds']:.2f}", f"{bare['seconds']:.2f}"),
        ("frames received", ours["frames"], bare["frames"]),
        ("frames per second", f"{ours['frames_per_s']:.1f}", f"{bare['frames_per_s']:.1f}"),
        ("frames lost", ours["lost"], bare["lost"]),
        ("messages missed by this client", ours["missed"]),
        ("points without a position", ours["without_position"]),
    ]
    for label, value in ours["latency_ms"].items():
        peer = bare["latency_ms"][label]
        rows.append((f"latency {label}, ms", f"{value:.2f}", f"{peer:.2f}", f"{value / peer:.1f}"))
    console.print(make_table(("figure", "Lumiline", "bare websocket", "ratio"), rows, TITLE))
    console.print(
        "latency: middle of the exposure to the message in the client's hands. The bare websocket "
        "only sends, as many messages as large, from their due time."
    )
