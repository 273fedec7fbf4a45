"""`lumiline bench`: speed measurements, each beside an alternative."""

import tempfile
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path

from rich.table import Table

from service.cli.output import console, fail, print_json, progress
from service.cli.service_process import running_service

BENCHMARKS = {
    "live": "60 s of the live pipeline: 4 sensors x 2048 pixels at 1 kHz to one websocket client",
    "load": "4 sensors x 2048 pixels at full rate, a recorder, 50 clients, some of them stalled",
    "openigtlink": "ten tools at 200 Hz to pyigtl, while another client stalls and leaves",
    "navigation": "simulated optics to an OpenIGTLink client: latency, jitter and tip errors",
    "hold": "a patient who moves, to the signal that holds the beam: latency, missed, false",
    "signal": "raw lines to peaks: rates and latency beside a memory copy, numba, NumPy, SciPy",
    "points": "readings to points, beside SciPy",
    "pose": "poses of ten tools from readings, beside SciPy; a tracker's step",
    "reconstruct": "readings to points through a correction table, beside SciPy, numba, CuPy",
    "calibration": "19 points x 4 sensors, beside SciPy and pyceres on eleven parameters",
    "rays": "exact rays through a lens, beside optiland",
    "decoder": "the serial protocol: bytes to exposures on one core; a million mutated messages",
    "clock": "a device's clock on the host's, from late arrivals, beside a decayed regression",
    "tracking": "2 to 20 markers followed on readings, beside Stone Soup's JPDA",
    "simulation": "simulated frames of a profile's device on one core, beside ideal lenses",
}

BASELINE_SECONDS = 10.0


def run(
    name: str | None, *, seconds: float, rate_hz: float, device: str | None, as_json: bool
) -> None:
    """List the benchmarks, or run one."""
    if name is None:
        table = Table(title="benchmarks: lumiline bench NAME", title_justify="left")
        table.add_column("name")
        table.add_column("what is measured")
        for row in BENCHMARKS.items():
            table.add_row(*row)
        console.print(table)
    elif name == "live":
        _live(seconds, as_json=as_json)
    elif name == "load":
        from service.cli import bench_load

        bench_load.run(rate_hz, seconds, as_json=as_json)
    elif name == "openigtlink":
        from service.cli import bench_openigtlink

        bench_openigtlink.run(seconds, as_json=as_json)
    elif name == "navigation":
        from service.cli import bench_navigation

        bench_navigation.run(1000.0, seconds, as_json=as_json)
    elif name == "hold":
        from service.cli import bench_beam_hold

        bench_beam_hold.run(1000.0, seconds, as_json=as_json)
    elif name == "signal":
        from benchmarks import signal

        signal.main([*(["--json"] if as_json else []), *(["--device", device] if device else [])])
    elif name == "points":
        from benchmarks import triangulation

        triangulation.main(["--json"] if as_json else [])
    elif name == "pose":
        from benchmarks import pose

        pose.main(["--json"] if as_json else [])
    elif name == "reconstruct":
        from benchmarks import mapped_reconstruction

        options = ["--json"] if as_json else []
        mapped_reconstruction.main([*options, *(["--device", device] if device else [])])
    elif name == "calibration":
        from benchmarks import calibration

        calibration.main(["--json"] if as_json else [])
    elif name == "rays":
        from benchmarks import ray_tracing

        ray_tracing.main(
            [*(["--json"] if as_json else []), *(["--device", device] if device else [])]
        )
    elif name == "decoder":
        from service.cli.bench_decoder import run as decoder

        decoder(as_json=as_json)
    elif name == "clock":
        from service.cli.bench_clock import run as clock

        clock(as_json=as_json)
    elif name == "tracking":
        from benchmarks import tracking

        tracking.main(["--json"] if as_json else [])
    elif name == "simulation":
        from benchmarks import simulation

        simulation.main(["--json"] if as_json else [])
    else:
        raise fail(f'there is no benchmark "{name}"; there are {", ".join(BENCHMARKS)}')


def _live(seconds: float, *, as_json: bool) -> None:
    from benchmarks.baseline_stream import running_baseline_stream
    from benchmarks.live import measure

    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        try:
            with progress("starting the service", quiet=as_json):
                url = stack.enter_context(running_service(Path(folder)))
            stream = url.replace("http", "ws", 1) + "/api/v1/stream?device=sim"
            with progress("streaming", seconds, quiet=as_json) as done:
                figures = measure(stream, seconds, done)
            stack.close()
            with (
                progress("a bare websocket beside it", BASELINE_SECONDS, quiet=as_json) as done,
                running_baseline_stream() as url,
            ):
                bare = measure(url, BASELINE_SECONDS, done)
        except RuntimeError as error:
            raise fail(str(error)) from error
    if as_json:
        print_json({"live": asdict(figures), "baseline_websocket": asdict(bare)})
        return
    table = Table(title=BENCHMARKS["live"], title_justify="left")
    table.add_column("figure")
    table.add_column("Lumiline", justify="right")
    table.add_column("bare websocket", justify="right")
    table.add_column("ratio", justify="right")
    table.add_row("duration, s", f"{figures.seconds:.2f}", f"{bare.seconds:.2f}")
    table.add_row("frames received", f"{figures.frames}", f"{bare.frames}")
    table.add_row("frames per second", f"{figures.frames_per_s:.1f}", f"{bare.frames_per_s:.1f}")
    table.add_row("frames lost", f"{figures.lost}", f"{bare.lost}")
    table.add_row("messages missed by this client", f"{figures.missed}")
    table.add_row("points without a position", f"{figures.without_position}")
    for label, value in figures.latency_ms.items():
        peer = bare.latency_ms[label]
        table.add_row(f"latency {label}, ms", f"{value:.2f}", f"{peer:.2f}", f"{value / peer:.1f}")
    console.print(table)
    console.print(
        "latency: middle of the exposure to the message in the client's hands. The bare websocket "
        "only sends, as many messages as large, from their due time."
    )
