"""`lumiline bench`: speed measurements, each beside an alternative."""

from importlib import import_module
from typing import Annotated, Final

import typer

from service.cli.options import AsJson, ComputeDevice, RateHz, refuse_unused
from service.cli.output import console, fail, make_table, print_json

BENCHMARKS: Final = {
    "live": "60 s of the live pipeline: 4 sensors x 2048 pixels at 1 kHz to one websocket client",
    "latency": "a serial device to one client, quiet and loaded, in turn with a bare relay",
    "load": "4 sensors x 2048 pixels at full rate, a recorder, 50 clients, some of them stalled",
    "rate": "the highest rate of a serial device that one client gets without loss",
    "openigtlink": "ten tools at 200 Hz to pyigtl, while another client stalls and leaves",
    "navigation": "simulated optics to an OpenIGTLink client: latency, jitter and tip errors",
    "hold": "a patient who moves, to the signal that holds the beam: latency, missed, false",
    "hostile-bodies": "the worst bodies of each scope: stalls of a stream, hold statuses, /healthz",
    "stalled-clients": "ten clients of a stream, without and with 100 others that never read",
    "bus": "a station at 5 kHz to 200 subscribers over NATS, beside a bare relay; 20 stalled ones",
    "dashboard": "the page in Chromium, visible and hidden: share of a core, delay, memory",
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
    *("live", "latency", "load", "openigtlink", "navigation", "hold", "hostile-bodies"),
    *("stalled-clients", "bus", "rate", "dashboard", "decoder", "clock"),
)
LOAD_RATE_HZ: Final = 5000.0
_MODULES: Final = {
    "points": "triangulation", "reconstruct": "mapped_reconstruction", "rays": "ray_tracing"
}  # fmt: skip
"""Modules of the package ``benchmarks`` that are not named as their benchmark."""
_ON_A_DEVICE: Final = ("signal", "reconstruct", "rays")
_TIMED: Final = (
    *("live", "latency", "load", "openigtlink", "navigation", "hold", "stalled-clients"),
    *("bus", "rate", "dashboard"),
)


def _complete_name(incomplete: str) -> list[str]:
    """Return the benchmarks whose names begin so, for the shell's completion."""
    return [name for name in BENCHMARKS if name.startswith(incomplete)]


def bench(
    context: typer.Context,
    name: Annotated[
        str | None,
        typer.Argument(
            help="live, load, signal, points, calibration, ...", autocompletion=_complete_name
        ),
    ] = None,
    seconds: Annotated[
        float, typer.Option(min=1.0, help="Duration of those of a running server.")
    ] = 60.0,
    rate_hz: RateHz = None,
    compute_device: ComputeDevice = None,
    as_json: AsJson = False,
) -> None:
    """List the benchmarks, or run one."""
    if name not in _TIMED:
        refuse_unused(context, f"here, only on {', '.join(_TIMED)}", "seconds")
    if name != "load":
        refuse_unused(context, "here, only on load", "rate_hz")
    if name not in _ON_A_DEVICE:
        refuse_unused(context, f"here, only on {', '.join(_ON_A_DEVICE)}", "compute_device")
    if name is None and as_json:
        print_json([{"name": one, "measured": what} for one, what in BENCHMARKS.items()])
    elif name is None:
        title = "benchmarks: lumiline bench NAME"
        console.print(
            make_table(("name", "what is measured"), BENCHMARKS.items(), title, texts=None)
        )
    elif name not in BENCHMARKS:
        raise fail(f'there is no benchmark "{name}"; there are {", ".join(BENCHMARKS)}')
    elif name in _OF_A_SERVICE:
        module = import_module(f"service.cli.bench_{name.replace('-', '_')}")
        module.run(seconds=seconds, rate_hz=rate_hz or LOAD_RATE_HZ, as_json=as_json)
    else:
        options = ["--json"] if as_json else []
        if compute_device:
            options += ["--device", compute_device]
        import_module(f"benchmarks.{_MODULES.get(name, name)}").main(options)
