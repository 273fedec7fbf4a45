"""`lumiline bench hold`: latency from patient motion to the beam-hold signal at a client."""

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final, cast

import numpy as np

from lumiline.client import Client
from service.cli.bench_service import (
    DEVICE,
    MARKERS_MM,
    Figures,
    device_counts,
    losses,
    measure_baseline_stream,
    run_benchmark,
    service_of_simulated_device,
    wait_for_frames,
)
from service.cli.output import console, make_table, progress

TITLE: Final = "markers that move 5 mm in 20 ms once a second, limit 2 mm, 4 sensors x 2048 pixels"
RATE_HZ: Final = 1000.0
CENTRE_MM: Final = (0.0, 0.0, 1500.0)
SHIFT_MM: Final = (4.0, 0.0, 3.0)
PERIOD_S: Final = 1.0
AWAY: Final = 0.4
MOVING_S: Final = 0.02
LIMIT_MM: Final = 2.0
RULES: Final = {"max_gap_s": 0.1, "settle_s": 0.1}
TOOL: Final = "patient"


def run(*, seconds: float, as_json: bool, **_: Any) -> None:
    """Measure, and print the figures beside those of a bare server."""
    run_benchmark(lambda folder: _measure(folder, seconds, quiet=as_json), _show, as_json=as_json)


def _measure(folder: Path, seconds: float, *, quiet: bool) -> Figures:
    from benchmarks.beam_hold import beginning, listen, step_us, summed
    from hardware.simulated.scenes import ShiftedPoints

    positions = (np.array(MARKERS_MM) + CENTRE_MM).tolist()
    scene = ShiftedPoints(tuple(map(tuple, positions)), SHIFT_MM, PERIOD_S, AWAY, MOVING_S)
    cycle = round(PERIOD_S * RATE_HZ)
    # The true shift in each frame of the cycle, shape (C, 3) [mm].
    truth = scene.shift((np.arange(cycle, dtype=np.float64) + 0.5) / RATE_HZ)
    late_ms = 1e3 * RULES["max_gap_s"]
    holds: dict[str, Any] = {}
    with service_of_simulated_device(folder, RATE_HZ, cycle, asdict(scene), quiet=quiet) as (
        service,
        client,
    ):
        client.start_device(DEVICE)
        wait_for_frames(client, cycle)
        # One after the other: the time that each takes is its own.
        for name, create in _HOLDS.items():
            create(client, positions)
            before = device_counts(client)
            wait_for_frames(client, before["frames_processed"] + 2 * cycle)
            before = device_counts(client)
            with progress(f"a hold by {name}", seconds, quiet=quiet) as report:
                received = listen(f"{service.stream_url}?device_id={DEVICE}", name, seconds, report)
            after = device_counts(client)
            begin = beginning(received.shifts, truth)
            holds[name] = {
                **asdict(summed(received, name, truth, LIMIT_MM, late_ms, begin)),
                "frames": after["frames_processed"] - before["frames_processed"],
                **losses(before, after),
                "messages_missed": received.missed,
            }
            client.delete_beam_hold(name)
    bare = measure_baseline_stream(quiet=quiet)
    return {
        "rate_hz": RATE_HZ,
        "holds": holds,
        "step_us": step_us(),
        "baseline_ms": {name: bare.latency_ms[name] for name in ("p50", "p99", "max")},
    }


def _hold_markers(client: Client, positions_mm: list[list[float]]) -> None:
    watch = {"kind": "strobed-markers", "markers": list(range(len(MARKERS_MM)))}
    _create(client, "markers", watch, {"positions_mm": positions_mm})


def _hold_tool(client: Client, _: list[list[float]]) -> None:
    strobe = list(range(len(MARKERS_MM)))
    client.create_tool(
        id=TOOL, device_id=DEVICE, markers_mm=MARKERS_MM, title="Patient", strobe_markers=strobe
    )
    pose = {"rotation": np.eye(3).tolist(), "translation_mm": CENTRE_MM}
    _create(client, "tool", {"kind": "tool", "tool_id": TOOL}, pose)


_HOLDS: Final[dict[str, Callable[[Client, list[list[float]]], None]]] = {
    "markers": _hold_markers,
    "tool": _hold_tool,
}
"""Makes a hold by the markers one by one, and by them as a tool."""


def _create(client: Client, name: str, watch: Any, reference: Any) -> None:
    client.create_beam_hold(
        id=name,
        device_id=DEVICE,
        title=name,
        watch=watch,
        limits={"shift_mm": LIMIT_MM},
        rules=cast("Any", RULES),
        reference=reference,
    )


def _show(figures: Figures) -> None:
    bare, holds = figures["baseline_ms"], figures["holds"]
    rows: list[list[object]] = []
    counts = ("movements", "already", "held", "missed", "late", "early", "false")
    for name in (*counts, "frames", "frames_lost", "frames_not_tracked", "messages_missed"):
        cells = [cell for hold in holds.values() for cell in (hold[name], "")]
        rows.append([name.replace("_", " "), *cells])
    for name in ("latency_ms", "signal_ms"):
        for label, peer in bare.items():
            cells = []
            for hold in holds.values():
                value = hold[name].get(label)
                measured = value is not None
                cells += [f"{value:.2f}", f"{value / peer:.1f}"] if measured else [None, None]
            rows.append([f"{name.removesuffix('_ms')} {label}, ms", *cells, f"{peer:.2f}"])
    columns = [heading for name in holds for heading in (f"hold by {name}", "over bare")]
    title = f"{TITLE}, {figures['rate_hz']:g} Hz"
    console.print(make_table(["figure", *columns, "bare server"], rows, title))
    steps = figures["step_us"]
    console.print(
        f"a monitor's step: {steps['markers']:.0f} us of four markers, "
        f"{steps['tool']:.0f} us of a tool"
    )
    for name, hold in holds.items():
        console.print(
            f"by {name}: held {_listed(hold['causes'])}; false {_listed(hold['false_causes'])}"
        )
    console.print(
        "latency: exposure of the first frame in which the true position is out of tolerance, to "
        "the signal in the client's hands; negative: held on the way there. signal: exposure of "
        "the frame that the signal is of, to the client. already: held from before. late: after "
        f"the longest gap of {1e3 * RULES['max_gap_s']:.0f} ms. false: while nothing moved. The "
        "bare server only sends, at 1 kHz."
    )


def _listed(causes: dict[str, int]) -> str:
    return ", ".join(f"{count} {cause}" for cause, count in causes.items()) or "none"
