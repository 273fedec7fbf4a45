"""`lumiline bench hold`: latency from patient motion to the beam-hold signal at a client."""

from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import httpx
import numpy as np
from rich.table import Table

from service.cli.bench_service import (
    DEVICE,
    answer,
    device_status,
    read_device,
    run_benchmark,
    wait_for_frames,
)
from service.cli.output import console, progress
from service.cli.service_process import service_process, simulated_device

if TYPE_CHECKING:
    from hardware.simulated.scenes import ShiftedPoints

TITLE: Final = "markers that move 5 mm in 20 ms once a second, limit 2 mm, 4 sensors x 2048 pixels"
MARKERS_MM: Final = ((0.0, 0.0, 0.0), (80.0, 0.0, 0.0), (0.0, 60.0, 0.0), (20.0, 15.0, 40.0))
CENTRE_MM: Final = (0.0, 0.0, 1500.0)
SHIFT_MM: Final = (4.0, 0.0, 3.0)
PERIOD_S: Final = 1.0
AWAY: Final = 0.4
MOVING_S: Final = 0.02
LIMIT_MM: Final = 2.0
_LOST: Final = ("frames_lost_device", "frames_dropped_ring")
RULES: Final = {"max_gap_s": 0.1, "settle_s": 0.1}
TOOL: Final = "patient"
BASELINE_SECONDS: Final = 10.0


def run(rate_hz: float, seconds: float, *, as_json: bool) -> None:
    """Measure, and print the figures beside those of a bare server."""
    run_benchmark(
        lambda folder: _measure(folder, rate_hz, seconds, quiet=as_json), _show, as_json=as_json
    )


def _measure(folder: Path, rate_hz: float, seconds: float, *, quiet: bool) -> dict[str, Any]:
    from benchmarks.baseline_stream import running_baseline_stream
    from benchmarks.beam_hold import beginning, listen, step_us, summed
    from benchmarks.live import measure
    from hardware.simulated.scenes import ShiftedPoints

    places = (np.array(MARKERS_MM) + CENTRE_MM).tolist()
    scene = ShiftedPoints(tuple(map(tuple, places)), SHIFT_MM, PERIOD_S, AWAY, MOVING_S)
    cycle = round(PERIOD_S * rate_hz)
    truth = _truth(scene, rate_hz, cycle)
    late_ms = 1e3 * RULES["max_gap_s"]
    found: dict[str, Any] = {}
    with ExitStack() as stack:
        with progress("starting the service", quiet=quiet):
            settings = {"scene": asdict(scene)}
            source = stack.enter_context(simulated_device(folder, rate_hz, cycle, settings))
            service = stack.enter_context(service_process(folder / "service"))
            client = stack.enter_context(httpx.Client(base_url=service.url, timeout=60.0))
            read_device(client, source)
            answer(client.post(f"/api/v1/devices/{DEVICE}/start"))
            wait_for_frames(client, cycle)
        url = f"{service.url.replace('http', 'ws', 1)}/api/v1/stream?device={DEVICE}"
        # One after the other: the time that each takes is its own.
        for name, prepare in (("markers", _watch_markers), ("tool", _watch_tool)):
            prepare(client, places)
            before = device_status(client)
            wait_for_frames(client, before["frames_processed"] + 2 * cycle)
            before = device_status(client)
            with progress(f"a hold by {name}", seconds, quiet=quiet) as done:
                heard = listen(url, name, seconds, done)
            after = device_status(client)
            begin = beginning(heard.shifts, truth)
            found[name] = asdict(summed(heard, name, truth, LIMIT_MM, late_ms, begin)) | {
                "frames": after["frames_processed"] - before["frames_processed"],
                "frames_lost": sum(after[one] - before[one] for one in _LOST),
                "frames_not_tracked": after["frames_not_tracked"] - before["frames_not_tracked"],
                "messages_missed": heard.missed,
            }
            client.delete(f"/api/v1/beam-holds/{name}").raise_for_status()
        stack.close()
        with (
            progress("a bare server beside it", BASELINE_SECONDS, quiet=quiet) as done,
            running_baseline_stream() as baseline_url,
        ):
            bare = measure(baseline_url, BASELINE_SECONDS, done)
    return {
        "rate_hz": rate_hz,
        "holds": found,
        "step_us": step_us(),
        "baseline_ms": {name: bare.latency_ms[name] for name in ("p50", "p99", "max")},
    }


def _truth(scene: "ShiftedPoints", rate_hz: float, cycle: int) -> np.ndarray[Any, Any]:
    """Return the true shift in each frame of the cycle, shape (C, 3) [mm]."""
    times: np.ndarray[Any, np.dtype[np.float64]] = (
        np.arange(cycle, dtype=np.float64) + 0.5
    ) / rate_hz
    return scene.shift(times)


def _watch_markers(client: httpx.Client, places: list[list[float]]) -> None:
    """Watch the markers one by one."""
    watch = {"kind": "strobed-markers", "markers": list(range(len(MARKERS_MM)))}
    _create(client, "markers", watch, {"positions_mm": places})


def _watch_tool(client: httpx.Client, _: list[list[float]]) -> None:
    """Watch the markers as a tool."""
    tool = {
        "id": TOOL,
        "device": DEVICE,
        "title": "Patient",
        "markers_mm": MARKERS_MM,
        "strobe_markers": list(range(len(MARKERS_MM))),
    }
    answer(client.post("/api/v1/tools", json=tool))
    place = {"rotation": np.eye(3).tolist(), "translation_mm": CENTRE_MM}
    _create(client, "tool", {"kind": "tool", "tool": TOOL}, place)


def _create(
    client: httpx.Client, name: str, watch: dict[str, Any], reference: dict[str, Any]
) -> None:
    hold = {
        "id": name,
        "device": DEVICE,
        "title": name,
        "watch": watch,
        "limits": {"shift_mm": LIMIT_MM},
        "rules": RULES,
        "reference": reference,
    }
    answer(client.post("/api/v1/beam-holds", json=hold))


def _show(figures: dict[str, Any]) -> None:
    bare = figures["baseline_ms"]
    table = Table(title=f"{TITLE}, {figures['rate_hz']:g} Hz", title_justify="left")
    table.add_column("figure")
    for name in figures["holds"]:
        table.add_column(f"hold by {name}", justify="right")
        table.add_column("over bare", justify="right")
    table.add_column("bare server", justify="right")
    counts = ("movements", "already", "held", "missed", "late", "early", "false")
    for what in (*counts, "frames", "frames_lost", "frames_not_tracked", "messages_missed"):
        cells = [cell for one in figures["holds"].values() for cell in (str(one[what]), "")]
        table.add_row(what.replace("_", " "), *cells)
    for what in ("latency_ms", "signal_ms"):
        for label, peer in bare.items():
            cells = []
            for one in figures["holds"].values():
                value = one[what].get(label)
                if value is None:
                    cells += ["-", "-"]
                    continue
                cells += [f"{value:.2f}", f"{value / peer:.1f}"]
            table.add_row(f"{what.removesuffix('_ms')} {label}, ms", *cells, f"{peer:.2f}")
    console.print(table)
    steps = figures["step_us"]
    console.print(
        f"a monitor's step: {steps['markers']:.0f} us of four markers, "
        f"{steps['tool']:.0f} us of a tool"
    )
    for name, one in figures["holds"].items():
        console.print(
            f"by {name}: held {_listed(one['causes'])}; false {_listed(one['false_causes'])}"
        )
    console.print(
        "latency: exposure of the first frame in which the true position is out of tolerance, to "
        "the signal in the client's hands; negative: held on the way there. signal: exposure of "
        "the frame that the signal is of, to the client. already: held from before. late: after "
        "the longest gap of "
        f"{1e3 * RULES['max_gap_s']:.0f} ms. false: while nothing moved. The bare server only "
        "sends, at 1 kHz."
    )


def _listed(causes: dict[str, int]) -> str:
    return ", ".join(f"{count} {cause}" for cause, count in causes.items()) or "none"
