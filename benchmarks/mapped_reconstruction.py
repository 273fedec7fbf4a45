"""Benchmark of triangulation with a correction table: ``-m benchmarks.mapped_reconstruction``.

Four sensors, a table of 20 x 20 x 20 cells of degree 3 and of degree 1, 1e3 to 1e6 points: from
readings in memory to positions, covariances and flags in memory, in float64. Beside it, in the
same run and on the same points, what a user would write: ``scipy.ndimage.map_coordinates`` (for
degree 1 also ``RegularGridInterpolator``) with batched NumPy solves, numba's parallel loop over our
own algorithm, and on a GPU CuPy's arrays. On a GPU "on the device" leaves the copies out.

The limit is arithmetic, not memory: a point reads 64 bytes and writes 112, and the table stays in
the caches, while one setting-up of its equations takes ``flops_of_equations`` additions and
multiplications (1,950 for degree 3, 630 for degree 1), and there are about six of them. Divisions
and roots are counted as one. Operations are of the algorithm, not of the compiled code; how many
times equations are set up is counted by the numba peer. The limit is what the CPUs reach in a
product of matrices, on a GPU in chains of fused multiply-adds, measured in the same run; the
share of bytes is beside it.
"""

import argparse
import json
import os
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from benchmarks.mapped_reconstruction_peers import (
    Task,
    arrays_method,
    by_map_coordinates,
    by_regular_grid,
    in_blocks,
    numba_method,
)
from benchmarks.triangulation import rig
from compute.mapping.grid import VoxelGrid
from compute.mapping.table import CorrectionTable, Degree
from compute.reconstruction.native.cuda_launch import CudaLaunch
from compute.reconstruction.solver import PointSolver

Array = NDArray[np.float64]
Row = dict[str, str | int | float]

SIZES = (1000, 100_000, 1_000_000)
SIGMA_PX = 0.02
HALF_EDGE_MM = 250.0
CELLS = 20
PEER_POINTS = 100_000
"""Most points of a run of arrays on the CPU: they take as long for each of more points."""
BLOCK_POINTS = 4096
BYTES_PER_POINT = 64 + 112


def task_of(degree: Degree) -> Task:
    """Return four cameras and a table of corrections of up to 8 px."""
    grid = VoxelGrid(
        (-HALF_EDGE_MM, -HALF_EDGE_MM, 1500.0 - HALF_EDGE_MM),
        (2.0 * HALF_EDGE_MM / CELLS,) * 3,
        (CELLS,) * 3,
    )
    nodes = np.linspace(-1.0, 1.0, CELLS + degree)
    x, y, z = np.meshgrid(nodes, nodes, nodes, indexing="ij")
    values = [8.0 * np.sin(2.0 * x + s) * np.cos(1.5 * y - s) + 0.5 * z for s in range(4)]
    corners = np.linspace(0.01, 0.03, (CELLS + 1) ** 3).reshape((CELLS + 1,) * 3)
    return Task(
        rig(),
        CorrectionTable(
            ("s0", "s1", "s2", "s3"),
            "0" * 64,
            grid,
            degree,
            np.stack(values),
            np.stack([corners**2] * 4),
            np.ones((4, CELLS, CELLS, CELLS), dtype=np.bool_),
        ),
        SIGMA_PX,
    )


def readings_of(task: Task, count: int) -> Array:
    """Return noisy readings (N, 4) of points over the table's box."""
    rng = np.random.default_rng(count)
    points = np.array([0.0, 0.0, 1500.0]) + 0.95 * HALF_EDGE_MM * rng.uniform(-1, 1, (count, 3))
    parts = range(0, count, BLOCK_POINTS)
    corrections = [task.corrections.at(points[at : at + BLOCK_POINTS]).value_px for at in parts]
    readings = task.cameras.project(points) - np.concatenate(corrections)
    return np.asarray(readings + SIGMA_PX * rng.standard_normal(readings.shape))


def flops_of_equations(degree: int, sensors: int = 4) -> int:
    """Return the operations of assembling and solving a point's equations once.

    Splines and their three slopes, summed along z, then y, then x: 4 operations a node, 6 a line,
    8 a sheet, for each sensor; the weights. Then for each sensor projection and slopes 38,
    correction and weights 14, the sums of squares and products 20; the step 48.
    """
    nodes = degree + 1
    weights = 3 * (26 if degree == 3 else 2)
    splines = sensors * (4 * nodes**3 + 6 * nodes**2 + 8 * nodes) + weights
    return splines + sensors * (38 + 14 + 20) + 48


def run(device: str | None = None, seconds: float = 1.0, most: int = SIZES[-1]) -> list[Row]:
    """Measure all methods, degrees and sizes; rows of the same keys."""
    rows: list[Row] = []
    limit = None
    for degree in (3, 1):
        task = task_of(degree)
        solver = PointSolver(task.cameras, None, task.corrections, device)
        if limit is None:
            limit = _limits(solver)
        peers = list(cpu_peers(task))
        own = numba_method(task)
        setups = 0.0
        if own is not None:
            setups = float(own(readings_of(task, SIZES[0]))[2].mean())
        per_point = setups * flops_of_equations(degree)
        for size in (size for size in SIZES if size <= most):
            readings = readings_of(task, size)
            sigma = np.full(4, SIGMA_PX)
            expected = solver.solve(readings, sigma).position_mm
            ours = _time(partial(solver.solve, readings, sigma), seconds)
            row = partial(_row, degree, size, ours / size, per_point, limit)
            rows.append(row(f"lumiline on {solver.device}", ours / size, 0.0))
            if isinstance(solver.launch, CudaLaunch):
                rows.append(row("lumiline, on the device", *_resident(solver, readings, seconds)))
                rows += [row(*peer) for peer in _cuda_peers(task, readings, expected, seconds)]
            for name, solve in peers:
                count = min(size, PEER_POINTS)
                off = np.abs(solve(readings[:count])[0] - expected[:count]).max()
                rows.append(
                    row(name, _time(partial(solve, readings[:count]), seconds) / count, off)
                )
            if own is not None:
                off = np.abs(own(readings)[0] - expected).max()
                rows.append(
                    row("numba, parallel", _time(partial(own, readings), seconds) / size, off)
                )
    return rows


def cpu_peers(task: Task) -> list[tuple[str, Callable[[Array], Any]]]:
    """Return the implementations with NumPy and SciPy."""
    interpolators = [("map_coordinates", by_map_coordinates(task, np, map_coordinates))]
    if task.corrections.degree == 1:
        interpolators.append(("RegularGridInterpolator", by_regular_grid(task)))
    return [
        (f"SciPy {name}, NumPy", in_blocks(arrays_method(task, np, table), BLOCK_POINTS))
        for name, table in interpolators
    ]


def _cuda_peers(
    task: Task, readings: Array, expected: Array, seconds: float
) -> list[tuple[str, float, float]]:
    """Return name, time per point [s] and difference of CuPy's methods, without copies."""
    import cupy as cp
    from cupyx.scipy.ndimage import map_coordinates as on_device

    solve = arrays_method(task, cp, by_map_coordinates(task, cp, on_device))
    there = cp.asarray(readings)

    def call() -> None:
        solve(there)
        cp.cuda.get_current_stream().synchronize()

    off = float(np.abs(cp.asnumpy(solve(there)[0]) - expected).max())
    return [("CuPy arrays, on the device", _time(call, seconds) / len(readings), off)]


def _resident(solver: PointSolver, readings: Array, seconds: float) -> tuple[float, float]:
    """Return the time per point [s] with readings and points in device memory."""
    launch = solver.launch
    assert isinstance(launch, CudaLaunch)
    count = min(len(readings), launch.most)
    launch.upload(readings[:count], np.full((count, 4), SIGMA_PX))

    def call() -> None:
        for _ in range(10):
            launch.launch()
        launch.wait()

    return _time(call, seconds) / 10 / count, 0.0


def _limits(solver: PointSolver) -> tuple[float, float]:
    """Return the measured operations and bytes per second of the device."""
    if isinstance(solver.launch, CudaLaunch):
        from benchmarks.float64_rates import float64_rates

        rates = float64_rates(solver.device)
        # There a multiplication and an addition are two instructions, fused they are one.
        return 2.0 * rates.adds_per_s, rates.bytes_per_s
    from benchmarks.signal import read_bytes_per_s

    size = 1500
    matrix = np.random.default_rng(0).random((size, size))
    best = min(_time(lambda: matrix @ matrix, 0.0) for _ in range(3))
    return 2.0 * size**3 / best, read_bytes_per_s()


def _row(
    degree: int,
    size: int,
    ours: float,
    operations: float,
    limit: tuple[float, float],
    method: str,
    each: float,
    off: float,
) -> Row:
    lumiline = method.startswith("lumiline")
    return {
        "degree": degree,
        "points": size,
        "method": method,
        "us_per_point": each * 1e6,
        "points_per_s": 1.0 / each,
        "times_ours": each / ours,
        "share_of_arithmetic": operations / each / limit[0] if lumiline else "",
        "share_of_bytes": BYTES_PER_POINT / each / limit[1] if lumiline else "",
        "difference_mm": "" if lumiline else float(off),
    }


def _time(call: Callable[[], object], seconds: float) -> float:
    """Return the median time of a call [s], of at least three after a warm-up."""
    call()
    times: list[float] = []
    end = time.perf_counter() + seconds
    while len(times) < 3 or (time.perf_counter() < end and len(times) < 1000):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def main(argv: Sequence[str] | None = None) -> int:
    """Print the rows as a table, or as JSON."""
    parser = argparse.ArgumentParser(prog="benchmarks.mapped_reconstruction", description=__doc__)
    parser.add_argument("--device", help="cpu, cuda:0, ...; the default is CUDA where there is one")
    parser.add_argument("--seconds", type=float, default=1.0, help="time for each method and size")
    parser.add_argument("--most", type=int, default=SIZES[-1], help="most points")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(argv)
    device = "cuda:0" if options.device == "cuda" else options.device
    rows = run(device, options.seconds, options.most)
    if options.json:
        json.dump(rows, sys.stdout, indent=2)
        print()
        return 0
    from benchmarks.signal import print_rows

    print_rows(f"readings to points through a table; {os.cpu_count()} CPUs", rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
