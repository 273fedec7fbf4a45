"""Benchmark of ray tracing against optiland: ``python -m benchmarks.ray_tracing``.

Through the plano-convex cylinder of thesis section 3.4, lens to sensor, both polarisations'
transmittances and the optical path included (optiland gives the path, and no transmittances).

On CUDA it also says what binds the kernel: the float64 operations of a ray, counted in the NumPy
tracer as it runs, against the device's measured rates, or the bytes of a ray against its measured
memory bandwidth.
"""

import argparse
import json
import statistics
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from importlib.util import find_spec
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from compute.optics.tracing.assembly import Assembly, Lens
from compute.optics.tracing.ray_tracer import INPUTS, OUTPUTS, RayTracer
from compute.optics.tracing.reference_tracer import empty_results, trace_chunk, trace_rays
from compute.optics.tracing.surface_records import pack
from compute.optics.tracing.surfaces import Aperture, Cylinder, Plane, SurfaceStack

Row = dict[str, str | int | float]
Array = NDArray[np.float64]

RAYS = 200_000
CUDA_RAYS = 1 << 22
DISTANCE_MM, HALF_FIELD_RAD = 1500.0, 0.33
BYTES_PER_RAY = 8.0 * (INPUTS + OUTPUTS)
BASE = "numpy"


def thesis_lens() -> SurfaceStack:
    """Return the lens of thesis section 3.4, convex side to the light, and its sensor."""
    lens = Lens((Cylinder(16.54), Plane()), (4.0,), (1.52,), Aperture(19.0, 42.25))
    return Assembly((lens,), sensor_z_mm=33.0).stack()


def rays_to_lens(count: int, seed: int = 1) -> tuple[Array, Array]:
    """Return origins across the field at 1.5 m, and directions to points across the lens."""
    rng = np.random.default_rng(seed)
    target = np.zeros((count, 3))
    target[:, 0], target[:, 1] = rng.uniform(-8.0, 8.0, count), rng.uniform(-18.0, 18.0, count)
    field = DISTANCE_MM * np.tan(HALF_FIELD_RAD)
    origin = np.full((count, 3), -DISTANCE_MM)
    origin[:, :2] = rng.uniform(-field, field, (count, 2))
    return origin, target - origin


class _Counting(np.ndarray[Any, np.dtype[Any]]):
    """An array that counts its arithmetic operations by name."""

    counts: ClassVar[Counter[str]] = Counter()

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        plain = [
            value.view(np.ndarray) if isinstance(value, _Counting) else value for value in inputs
        ]
        result = np.asarray(getattr(ufunc, method)(*plain, **options))
        self.counts[ufunc.__name__] += result.size
        return result.view(_Counting)

    def __array_function__(self, function: Any, types: Any, args: Any, options: Any) -> Any:
        return np.asarray(super().__array_function__(function, types, args, options)).view(
            _Counting
        )


def operations_per_ray(stack: SurfaceStack) -> dict[str, float]:
    """Return the float64 operations of a ray that arrives, by kind.

    Counted in the NumPy tracer: it works out both roots of a quadric and both of two
    alternatives, some ten additions more than the kernel. Comparisons, signs and choices are
    not counted.
    """
    count = 1000
    origins, directions = rays_to_lens(count)
    _Counting.counts.clear()
    trace_chunk(
        pack(stack),
        origins.view(_Counting),
        directions.view(_Counting),
        empty_results(count),
        slice(0, count),
    )
    kinds = {
        "adds": ("add", "subtract", "multiply"),
        "divisions": ("divide",),
        "roots": ("sqrt",),
    }
    return {
        kind: sum(_Counting.counts[name] for name in names) / count for kind, names in kinds.items()
    }


def run(device: str | None = None, seconds: float = 0.5, *, peer: bool = True) -> list[Row]:
    """Time every tracing method; one row each.

    Rows have the keys rays, method, device, time_us (median of a call), rays_per_s, times_numpy
    (how many times the speed of NumPy), and where the peer is there times_peer.
    """
    stack = thesis_lens()
    rows: list[Row] = []
    small = rays_to_lens(RAYS)
    rows.append(_row(RAYS, BASE, "cpu", _median_us(partial(trace_rays, stack, *small), seconds)))
    tracer = RayTracer(stack, device)
    on_cuda = tracer.device.startswith("cuda")
    rays = rays_to_lens(CUDA_RAYS) if on_cuda else small
    call_us = _median_us(partial(tracer.trace, *rays), seconds)
    rows.append(_row(len(rays[0]), "warp, trace()", tracer.device, call_us))
    kernel_us = _kernel_us(tracer, seconds)
    rows.append(_row(len(rays[0]), "warp, rays on the device", tracer.device, kernel_us))
    if peer and find_spec("optiland"):
        from benchmarks.ray_tracing_peer import optiland_tracer

        origins, directions = small
        directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        trace = partial(optiland_tracer(stack), origins, directions)
        rows.append(_row(RAYS, "optiland", "cpu", _median_us(trace, seconds)))
    for row in rows:
        row["times_numpy"] = float(row["rays_per_s"]) / float(rows[0]["rays_per_s"])
        if rows[-1]["method"] == "optiland":
            row["times_peer"] = float(row["rays_per_s"]) / float(rows[-1]["rays_per_s"])
    return rows


def limits(device: str, rays_per_s: float) -> Row:
    """Return the limiting resource of the CUDA kernel, and the fraction of it reached."""
    from benchmarks.float64_rates import float64_rates

    rates = float64_rates(device)
    operations = operations_per_ray(thesis_lens())
    arithmetic_s = (
        operations["adds"] / rates.adds_per_s
        + operations["divisions"] / rates.divisions_per_s
        + operations["roots"] / rates.roots_per_s
    )
    memory_s = BYTES_PER_RAY / rates.bytes_per_s
    return {
        **{f"{kind}_per_ray": value for kind, value in operations.items()},
        "adds_per_s": rates.adds_per_s,
        "divisions_per_s": rates.divisions_per_s,
        "roots_per_s": rates.roots_per_s,
        "bytes_per_ray": BYTES_PER_RAY,
        "bytes_per_s": rates.bytes_per_s,
        "arithmetic_rays_per_s": 1.0 / arithmetic_s,
        "memory_rays_per_s": 1.0 / memory_s,
        "binds": "arithmetic" if arithmetic_s > memory_s else "memory",
        "share_reached": rays_per_s * max(arithmetic_s, memory_s),
    }


def _row(rays: int, method: str, device: str, time_us: float) -> Row:
    return {
        "rays": rays,
        "method": method,
        "device": device,
        "time_us": time_us,
        "rays_per_s": rays / time_us * 1e6,
    }


def _median_us(call: Callable[[], object], seconds: float) -> float:
    """Return the median time of a call [us], after a warm-up call."""
    call()
    times: list[int] = []
    while len(times) < 3 or (sum(times) < seconds * 1e9 and len(times) < 10_000):
        start = time.perf_counter_ns()
        call()
        times.append(time.perf_counter_ns() - start)
    return statistics.median(times) / 1e3


def _kernel_us(tracer: RayTracer, seconds: float) -> float:
    """Return the time of a launch [us], from launches queued one after another."""
    launches = 20 if tracer.device.startswith("cuda") else 1

    def queue() -> None:
        for _ in range(launches):
            tracer.launch()
        tracer.wait()

    return _median_us(queue, seconds) / launches


def main(argv: Sequence[str] | None = None) -> int:
    """Print the rows as a table, or as JSON."""
    parser = argparse.ArgumentParser(prog="benchmarks.ray_tracing", description=__doc__)
    parser.add_argument("--device", help="cpu, cuda:0, ...; the default is CUDA where there is one")
    parser.add_argument("--seconds", type=float, default=0.5, help="time for each method")
    parser.add_argument(
        "--peer",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="optiland beside it, where it is installed",
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(argv)
    device = "cuda:0" if options.device == "cuda" else options.device
    rows = run(device, options.seconds, peer=options.peer)
    kernel = next(row for row in rows if row["method"] == "warp, rays on the device")
    bound = (
        limits(str(kernel["device"]), float(kernel["rays_per_s"]))
        if str(kernel["device"]).startswith("cuda")
        else None
    )
    if options.json:
        json.dump({"rows": rows, "limits": bound}, sys.stdout, indent=2)
        print()
        return 0
    print(f"{'rays':>9}  {'method':26} {'device':8} {'ms':>9} {'Mrays/s':>9} {'x numpy':>8} x peer")
    for row in rows:
        beside = f"{row['times_peer']:6.2f}" if "times_peer" in row else ""
        print(
            f"{row['rays']:9}  {row['method']:26} {row['device']:8} "
            f"{float(row['time_us']) / 1e3:9.3f} {float(row['rays_per_s']) / 1e6:9.2f} "
            f"{row['times_numpy']:8.2f} {beside}"
        )
    if bound:
        print_limits(bound)
    return 0


def print_limits(bound: Row) -> None:
    """Print the limiting resource of the kernel."""
    for kind in ("adds", "divisions", "roots"):
        print(
            f"float64 {kind}: {bound[f'{kind}_per_ray']:.0f} of a ray, "
            f"{float(bound[f'{kind}_per_s']) / 1e9:.0f} G/s measured"
        )
    print(
        f"memory: {bound['bytes_per_ray']:.0f} bytes of a ray, "
        f"{float(bound['bytes_per_s']) / 1e9:.0f} GB/s measured"
    )
    print(
        f"limits: {float(bound['arithmetic_rays_per_s']) / 1e6:.0f} Mrays/s by arithmetic, "
        f"{float(bound['memory_rays_per_s']) / 1e6:.0f} by memory; {bound['binds']} binds, "
        f"{100.0 * float(bound['share_reached']):.0f} % of it reached"
    )


if __name__ == "__main__":
    sys.exit(main())
