"""Benchmark of triangulation against SciPy: ``python -m benchmarks.triangulation``.

Points seen by four sensors with noise, once with unequal deviations: what a weighted fit of all
points at once costs and gains beside the linear solution and beside ``scipy.optimize`` point by
point, which is what a user would write.
"""

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from compute.camera.stack import CameraStack
from compute.optics.sensor_placement import place_sensor
from compute.reconstruction.triangulation import reconstruct, triangulate_linear

Array = NDArray[np.float64]
Row = dict[str, str | int | float]

SIZES = (1, 16, 256, 4096)
PEER_POINTS = 64
"""Most points of a run for the point-by-point peer; its time grows with their number."""
SIGMA_PX = np.array([0.02, 0.02, 0.02, 0.4])
"""One of the sensors is bad: what weights are for."""


@dataclass(frozen=True)
class Method:
    """A reconstruction method: name, maximum number of points, readings (N, 4) to points (N, 3)."""

    name: str
    most: int
    solve: Callable[[Array], Array]


def rig() -> CameraStack:
    """Four sensors on a bar of 600 mm that read in four directions, aimed 1.5 m away."""
    placed = [
        place_sensor(
            f"s{index}",
            lens_position_mm=(x, 0.0, 0.0),
            aim_mm=(0.0, 0.0, 1500.0),
            measured_direction=(float(np.cos(angle)), float(np.sin(angle)), 0.0),
            principal_distance_mm=36.0,
            pixels=2048,
            pitch_um=12.0,
        )
        for index, (x, angle) in enumerate(
            zip((-300.0, -100.0, 100.0, 300.0), np.pi / 2 + np.pi / 4 * np.arange(4), strict=True)
        )
    ]
    return CameraStack.of([sensor.model for sensor in placed])


def run(seconds: float = 0.3) -> list[Row]:
    """Measure all methods and sizes; the peers' times are relative to ours."""
    cameras = rig()
    methods = (
        Method("lumiline reconstruct", 10**9,
               lambda q: reconstruct(cameras, q, SIGMA_PX).position_mm),
        Method("lumiline linear [5.24]", 10**9, lambda q: triangulate_linear(cameras, q)),
        Method("scipy.optimize.least_squares, each point", PEER_POINTS,
               lambda q: _each_point(cameras, q)),
    )  # fmt: skip
    rows: list[Row] = []
    for size in SIZES:
        rng = np.random.default_rng(size)
        points = np.array([0.0, 0.0, 1500.0]) + rng.uniform(-200.0, 200.0, (size, 3))
        readings = cameras.project(points) + SIGMA_PX * rng.standard_normal((size, 4))
        ours = 0.0
        for method in methods:
            count = min(size, method.most)
            found = method.solve(readings[:count])
            each = _time(partial(method.solve, readings[:count]), seconds) / count
            ours = ours or each
            error = np.sqrt(((found - points[:count]) ** 2).sum(axis=1).mean())
            rows.append(
                {
                    "points": size,
                    "method": method.name,
                    "time_us_per_point": each * 1e6,
                    "times_ours": each / ours,
                    "rms_error_mm": float(error),
                }
            )
    return rows


def _each_point(cameras: CameraStack, readings: Array) -> Array:
    start = triangulate_linear(cameras, readings)

    def solve(row: Array, first: Array) -> Array:
        def residuals(x: Array) -> Array:
            projected: Array = (cameras.project(x[None])[0] - row) / SIGMA_PX
            return projected

        return np.asarray(least_squares(residuals, first, method="lm").x)

    return np.array([solve(row, first) for row, first in zip(readings, start, strict=True)])


def _time(call: Callable[[], object], seconds: float) -> float:
    """Return the median time of a call [s], of at least five."""
    times: list[float] = []
    end = time.perf_counter() + seconds
    while len(times) < 5 or time.perf_counter() < end:
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def main(argv: Sequence[str] | None = None) -> int:
    """Print the rows as a table, or as JSON."""
    parser = argparse.ArgumentParser(prog="benchmarks.triangulation", description=__doc__)
    parser.add_argument("--seconds", type=float, default=0.3, help="time for each method and size")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(argv)
    rows = run(options.seconds)
    if options.json:
        json.dump(rows, sys.stdout, indent=2)
        print()
        return 0
    print(f"{'points':>7}  {'method':42} {'us/point':>10} {'x ours':>8} {'RMS mm':>8}")
    for row in rows:
        print(
            f"{row['points']:>7}  {row['method']:42} {row['time_us_per_point']:10.2f} "
            f"{row['times_ours']:8.2f} {row['rms_error_mm']:8.4f}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
