"""`lumiline bench navigation`: simulated optics to OpenIGTLink, latency, jitter and tip errors."""

from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit

import httpx
import numpy as np
from numpy.typing import NDArray
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
from service.cli.service_process import free_port, service_process, simulated_device

if TYPE_CHECKING:
    from benchmarks.navigation import Received
    from hardware.simulated.scenes import MovingTools

TITLE: Final = "a tool of four strobed markers, 4 sensors x 2048 pixels, to an OpenIGTLink client"
TOOL: Final = "pointer"
MARKERS_MM: Final = ((0.0, 0.0, 0.0), (80.0, 0.0, 0.0), (0.0, 60.0, 0.0), (20.0, 15.0, 40.0))
TIP_MM: Final = (-150.0, 0.0, 0.0)
BASELINE_SECONDS: Final = 10.0


def run(rate_hz: float, seconds: float, *, as_json: bool) -> None:
    """Measure, and print the figures beside those of a bare server."""
    run_benchmark(
        lambda folder: _measure(folder, rate_hz, seconds, quiet=as_json), _show, as_json=as_json
    )


def _measure(folder: Path, rate_hz: float, seconds: float, *, quiet: bool) -> dict[str, Any]:
    from benchmarks.baseline_transforms import running_baseline_transforms
    from benchmarks.navigation import summed, transforms
    from hardware.simulated.scenes import MovingTool, MovingTools

    scene = MovingTools((MovingTool(MARKERS_MM),))
    cycle = round(scene.period_s * rate_hz)
    shown = {"kind": "moving-tools", "tools": [{"markers_mm": MARKERS_MM}]}
    port = free_port()
    settings = {"openigtlink_port": str(port), "openigtlink_rate_hz": "10000"}
    with ExitStack() as stack:
        with progress("starting the service", quiet=quiet):
            source = stack.enter_context(simulated_device(folder, rate_hz, cycle, {"scene": shown}))
            service = stack.enter_context(service_process(folder / "service", settings))
            with httpx.Client(base_url=service.url, timeout=60.0) as client:
                _start(client, source)
                wait_for_frames(client, cycle)
                before = device_status(client)
        with progress("receiving", seconds, quiet=quiet) as done:
            received = list(transforms("127.0.0.1", port, seconds, done))
        with httpx.Client(base_url=service.url, timeout=60.0) as client:
            after = device_status(client)
        stack.close()
        with (
            progress("a bare server beside it", BASELINE_SECONDS, quiet=quiet) as done,
            running_baseline_transforms() as url,
        ):
            address = urlsplit(url)
            assert address.hostname is not None
            assert address.port is not None
            bare = list(transforms(address.hostname, address.port, BASELINE_SECONDS, done))
    # The first may be of header version 1, before the server knows better: it has no number.
    name = f"{TOOL}ToTracker"
    own = [one for one in received if one.device == name and one.sequence >= 0]
    errors = _tip_errors(own, scene, rate_hz, cycle)
    return {
        "rate_hz": rate_hz,
        "lumiline": asdict(summed(own)),
        "bare": asdict(summed(bare)),
        "frames_lost": sum(
            after[name] - before[name] for name in ("frames_lost_device", "frames_dropped_ring")
        ),
        "frames_not_tracked": after["frames_not_tracked"] - before["frames_not_tracked"],
        "tip_error_mm": {
            "rms": float(np.sqrt(np.mean(np.square(errors)))),
            "p95": float(np.percentile(errors, 95.0)),
            "max": float(errors.max()),
        },
    }


def _tip_errors(
    received: "list[Received]", scene: "MovingTools", rate_hz: float, cycle: int
) -> NDArray[np.float64]:
    """Return how far each tip is from the truth of its frame [mm].

    Where in its cycle the device was when the service began to count is not told: it is where the
    tips fit best.
    """
    tip = np.array(TIP_MM)
    times: NDArray[np.float64] = (np.arange(cycle, dtype=np.float64) + 0.5) / rate_hz
    rotation, origin = scene.pose(0, times)
    truth = rotation @ tip + origin
    matrices = np.array([one.matrix for one in received])
    found = matrices[:, :, :3] @ tip + matrices[:, :, 3]
    numbers = np.array([one.sequence for one in received])
    best = min(
        (
            np.linalg.norm(found - truth[(numbers + begin) % cycle], axis=1)
            for begin in range(cycle)
        ),
        key=lambda errors: float((errors**2).mean()),
    )
    return np.asarray(best)


def _start(client: httpx.Client, source: dict[str, Any]) -> None:
    """Have the device read, and tell the server of the tool."""
    read_device(client, source)
    tool = {
        "id": TOOL,
        "device": DEVICE,
        "title": "Pointer",
        "markers_mm": MARKERS_MM,
        "strobe_markers": list(range(len(MARKERS_MM))),
        "tip_mm": TIP_MM,
    }
    answer(client.post("/api/v1/tools", json=tool))
    answer(client.post(f"/api/v1/devices/{DEVICE}/start"))


def _show(figures: dict[str, Any]) -> None:
    ours, bare = figures["lumiline"], figures["bare"]
    table = Table(title=f"{TITLE}, {figures['rate_hz']:g} Hz", title_justify="left")
    table.add_column("figure")
    table.add_column("Lumiline", justify="right")
    table.add_column("bare server", justify="right")
    table.add_column("ratio", justify="right")
    table.add_row("duration, s", f"{ours['seconds']:.1f}", f"{bare['seconds']:.1f}")
    table.add_row("transforms", f"{ours['transforms']}", f"{bare['transforms']}")
    table.add_row("out of order", f"{ours['out_of_order']}", f"{bare['out_of_order']}")
    table.add_row("frames lost", f"{figures['frames_lost']}")
    table.add_row(
        "frames without a pose, the computer being slow", f"{figures['frames_not_tracked']}"
    )
    for what in ("latency_ms", "jitter_ms"):
        for label, value in ours[what].items():
            peer = bare[what][label]
            name = f"{what.removesuffix('_ms')} {label}, ms"
            table.add_row(name, f"{value:.2f}", f"{peer:.2f}", f"{value / peer:.1f}")
    for label, value in figures["tip_error_mm"].items():
        table.add_row(f"tip error {label}, mm", f"{value:.3f}")
    console.print(table)
    console.print(
        "latency: middle of the exposure to the transform in the client's hands; jitter: how far "
        "the time between two transforms is from that between their exposures. The bare server "
        "only sends, at 1 kHz. Tip: 150 mm from the first marker, against the simulated truth."
    )
