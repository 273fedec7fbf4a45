"""`lumiline bench navigation`: simulated optics to OpenIGTLink, latency, jitter and tip errors."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from service.cli.bench_service import (
    BASELINE_SECONDS,
    DEVICE,
    MARKERS_MM,
    Figures,
    device_counts,
    losses,
    run_benchmark,
    service_of_simulated_device,
    wait_for_frames,
)
from service.cli.output import console, make_table, progress
from service.cli.service_process import free_port

if TYPE_CHECKING:
    from benchmarks.navigation import Received
    from hardware.simulated.scenes import MovingTools

TITLE: Final = "a tool of four strobed markers, 4 sensors x 2048 pixels, to an OpenIGTLink client"
RATE_HZ: Final = 1000.0
TOOL: Final = "pointer"
TIP_MM: Final = (-150.0, 0.0, 0.0)


def run(*, seconds: float, as_json: bool, **_: Any) -> None:
    """Measure, and print the figures beside those of a bare server."""
    run_benchmark(lambda folder: _measure(folder, seconds, quiet=as_json), _show, as_json=as_json)


def _measure(folder: Path, seconds: float, *, quiet: bool) -> Figures:
    from benchmarks.baseline_transforms import running_baseline_transforms
    from benchmarks.navigation import summed, transforms
    from hardware.simulated.scenes import MovingTool, MovingTools

    scene = MovingTools((MovingTool(MARKERS_MM),))
    cycle = round(scene.period_s * RATE_HZ)
    scene_document = {"kind": "moving-tools", "tools": [{"markers_mm": MARKERS_MM}]}
    port = free_port()
    settings = {"openigtlink_port": str(port), "openigtlink_rate_hz": "10000"}
    with service_of_simulated_device(
        folder, RATE_HZ, cycle, scene_document, settings, quiet=quiet
    ) as (
        _,
        client,
    ):
        client.create_tool(
            id=TOOL, device_id=DEVICE, markers_mm=MARKERS_MM, title="Pointer", tip_mm=TIP_MM,
            strobe_markers=list(range(len(MARKERS_MM))),
        )  # fmt: skip
        client.start_device(DEVICE)
        wait_for_frames(client, cycle)
        before = device_counts(client)
        with progress("receiving", seconds, quiet=quiet) as report:
            received = list(transforms("127.0.0.1", port, seconds, report))
        after = device_counts(client)
    with (
        progress("a bare server beside it", BASELINE_SECONDS, quiet=quiet) as report,
        running_baseline_transforms() as url,
    ):
        address = urlsplit(url)
        assert address.hostname is not None
        assert address.port is not None
        bare = list(transforms(address.hostname, address.port, BASELINE_SECONDS, report))
    # The first may be of header version 1, before the server knows better: it has no number.
    name = f"{TOOL}ToTracker"
    ours = [one for one in received if one.device == name and one.sequence >= 0]
    errors = _tip_errors(ours, scene, cycle)
    return {
        "rate_hz": RATE_HZ,
        "lumiline": asdict(summed(ours)),
        "bare": asdict(summed(bare)),
        **losses(before, after),
        "tip_error_mm": {
            "rms": float(np.sqrt(np.mean(np.square(errors)))),
            "p95": float(np.percentile(errors, 95.0)),
            "max": float(errors.max()),
        },
    }


def _tip_errors(
    received: "list[Received]", scene: "MovingTools", cycle: int
) -> NDArray[np.float64]:
    """Return how far each tip is from the truth of its frame [mm].

    The phase of the device's cycle at the first frame is not known: the one that fits best counts.
    """
    tip = np.array(TIP_MM)
    times: NDArray[np.float64] = (np.arange(cycle, dtype=np.float64) + 0.5) / RATE_HZ
    rotation, origin = scene.pose(0, times)
    truth = rotation @ tip + origin
    matrices = np.array([one.matrix for one in received])
    tips = matrices[:, :, :3] @ tip + matrices[:, :, 3]
    numbers = np.array([one.sequence for one in received])
    best = min(
        (np.linalg.norm(tips - truth[(numbers + begin) % cycle], axis=1) for begin in range(cycle)),
        key=lambda errors: float((errors**2).mean()),
    )
    return np.asarray(best)


def _show(figures: Figures) -> None:
    ours, bare = figures["lumiline"], figures["bare"]
    rows: list[tuple[object, ...]] = [
        ("duration, s", f"{ours['seconds']:.1f}", f"{bare['seconds']:.1f}"),
        ("transforms", ours["transforms"], bare["transforms"]),
        ("out of order", ours["out_of_order"], bare["out_of_order"]),
        ("frames lost", figures["frames_lost"]),
        ("frames without a pose, the computer being slow", figures["frames_not_tracked"]),
    ]
    for name in ("latency_ms", "jitter_ms"):
        for label, value in ours[name].items():
            peer = bare[name][label]
            heading = f"{name.removesuffix('_ms')} {label}, ms"
            rows.append((heading, f"{value:.2f}", f"{peer:.2f}", f"{value / peer:.1f}"))
    for label, value in figures["tip_error_mm"].items():
        rows.append((f"tip error {label}, mm", f"{value:.3f}"))
    title = f"{TITLE}, {figures['rate_hz']:g} Hz"
    console.print(make_table(("figure", "Lumiline", "bare server", "ratio"), rows, title))
    console.print(
        "latency: middle of the exposure to the transform in the client's hands; jitter: how far "
        "the time between two transforms is from that between their exposures. The bare server "
        "only sends, at 1 kHz. Tip: 150 mm from the first marker, against the simulated truth."
    )
