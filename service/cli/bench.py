"""`lumiline bench`: speed measurements, each beside an alternative."""

from importlib import import_module
from typing import Annotated, Final

import typer

from service.cli.output import AsJson, console, fail, make_table

BENCHMARKS: Final = {
    "live": "60 s of the live pipeline: 4 sensors x 2048 pixels at 1 kHz to one websocket client",
    "load": "4 sensors x 2048 pixels at full rate, a recorder, 50 clients, some of them stalled",
    "openigtlink": "ten tools at 200 Hz to pyigtl, while another client stalls and leaves",
    "navigation": "simulated optics to an OpenIGTLink client: latency, jitter and tip errors",
    "hold": "a patient who moves, to the signal that holds the beam: latency, missed, false",
    "hostile-bodies": "the worst bodies of each scope: stalls of a stream, hold statuses, /healthz",
    "signal": "raw scans to peaks: rates and latency beside a memory copy, numba, NumPy, SciPy",
    "points": "readings to points, beside SciPy",
    "pose": "poses of ten tools from readings, beside SciPy; a tracker's step",
    "reconstruct": "readings to points through a correction table, beside SciPy, numba, CuPy",
    "calibration": "19 points x 4 sensors, beside SciPy and pyceres on eleven parameters",
    "rays": "exact rays through a lens, beside optiland",
    "decoder": "the serial protocol: bytes to exposures on one core; a million mutated messages",
    "clock": "a device's clock on the host's, from late arrivals, beside a decayed regression",
    "tracking": "2 to 20 markers tracked from readings, beside Stone Soup's JPDA",
    "simulation": "simulated frames of a profile's device on one core, beside ideal lenses",
}
_OF_A_SERVICE: Final = (
    *("live", "load", "openigtlink", "navigation", "hold", "hostile-bodies", "decoder", "clock"),
)
_MODULES: Final = {
    "points": "triangulation", "reconstruct": "mapped_reconstruction", "rays": "ray_tracing"
}  # fmt: skip
"""Modules of the package ``benchmarks`` that are not named as their benchmark."""
_ON_A_DEVICE: Final = ("signal", "reconstruct", "rays")


def bench(
    name: Annotated[
        str | None, typer.Argument(help="live, load, signal, points, calibration, ...")
    ] = None,
    seconds: Annotated[
        float, typer.Option(min=1.0, help="Duration of those of a running server.")
    ] = 60.0,
    rate: Annotated[float, typer.Option(min=1.0, help="Frames a second of load.")] = 5000.0,
    device: Annotated[
        str | None, typer.Option(help="cpu, cuda:0, ... for signal, reconstruct, rays.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List the benchmarks, or run one."""
    if name is None:
        title = "benchmarks: lumiline bench NAME"
        console.print(
            make_table(("name", "what is measured"), BENCHMARKS.items(), title, texts=None)
        )
    elif name not in BENCHMARKS:
        raise fail(f'there is no benchmark "{name}"; there are {", ".join(BENCHMARKS)}')
    elif name in _OF_A_SERVICE:
        module = import_module(f"service.cli.bench_{name.replace('-', '_')}")
        module.run(seconds=seconds, rate_hz=rate, as_json=as_json)
    else:
        options = ["--json"] if as_json else []
        if device and name in _ON_A_DEVICE:
            options += ["--device", device]
        import_module(f"benchmarks.{_MODULES.get(name, name)}").main(options)
