"""Peers of triangulation with a correction table: NumPy or CuPy arrays, and numba."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.mapping.table import CorrectionTable

Array = NDArray[np.float64]

STEP_THRESHOLD_MM = 1e-6
MAX_ITERATIONS = 30


@dataclass(frozen=True, eq=False)
class Task:
    """Input of all methods: cameras without distortion, a correction table, the noise."""

    cameras: CameraStack
    corrections: CorrectionTable
    sigma_px: float


Interpolate = Callable[[Any], Any]
"""Takes points (N, 3); returns corrections and their variances, each (N, S)."""


def by_map_coordinates(task: Task, xp: Any, map_coordinates: Any) -> Interpolate:
    """Return the table by ``scipy.ndimage.map_coordinates`` or CuPy's, sensor by sensor."""
    table = task.corrections
    origin, pitch = xp.asarray(table.grid.origin_mm), xp.asarray(table.grid.pitch_mm)
    values, variance = xp.asarray(table.coefficients_px), xp.asarray(table.variance_px2)
    # Its splines of order 3 begin one node before ours.
    shift = 1.0 if table.degree == 3 else 0.0

    def interpolate(points: Any) -> Any:
        position = ((points - origin) / pitch).T
        options = {"mode": "nearest", "prefilter": False}
        value = [
            map_coordinates(nodes, position + shift, order=table.degree, **options)
            for nodes in values
        ]
        spread = [map_coordinates(nodes, position, order=1, **options) for nodes in variance]
        return xp.stack(value, axis=1), xp.stack(spread, axis=1)

    return interpolate


def by_regular_grid(task: Task) -> Interpolate:
    """Return a table of degree 1 by ``scipy.interpolate.RegularGridInterpolator``."""
    from scipy.interpolate import RegularGridInterpolator

    table = task.corrections
    axes = [
        start + step * np.arange(count + 1)
        for start, step, count in zip(
            table.grid.origin_mm, table.grid.pitch_mm, table.grid.cells, strict=True
        )
    ]
    nodes = np.concatenate([table.coefficients_px, table.variance_px2])
    grid = RegularGridInterpolator(axes, np.moveaxis(nodes, 0, -1))
    sensors = len(table.sensors)

    def interpolate(points: Any) -> Any:
        both = grid(np.clip(points, table.grid.origin_mm, table.grid.end_mm))
        return both[:, :sensors], both[:, sensors:]

    return interpolate


def arrays_method(task: Task, xp: Any, interpolate: Interpolate) -> Callable[[Any], Any]:
    """Return readings (N, S) to positions and covariances by batched solves of arrays.

    From the planes' linear solution; then correct, one Gauss-Newton step, and again until the
    steps are below a nanometre.
    """
    cameras = task.cameras
    matrices, rotation = xp.asarray(cameras.matrices), xp.asarray(cameras.rotation)
    offset = xp.asarray(cameras.offset_mm)
    c, p0 = xp.asarray(cameras.principal_distance_px), xp.asarray(cameras.principal_point_px)

    def normal_step(rows: Any, right: Any) -> Any:
        transposed = rows.transpose(0, 2, 1)
        return xp.linalg.solve(transposed @ rows, transposed @ right[..., None])[..., 0]

    def solve(readings: Any) -> Any:
        planes = matrices[:, 0] - readings[..., None] * matrices[:, 1]
        points = normal_step(planes[..., :3], -planes[..., 3])
        for _ in range(MAX_ITERATIONS):
            correction, variance = interpolate(points)
            x = points @ rotation[:, 0].T + offset[:, 0]
            z = points @ rotation[:, 2].T + offset[:, 2]
            u = x / z
            slope = (c / z)[..., None] * (rotation[:, 0] - u[..., None] * rotation[:, 2])
            weight = 1.0 / xp.sqrt(task.sigma_px**2 + variance)
            rows = slope * weight[..., None]
            step = normal_step(rows, weight * (readings + correction - p0 - c * u))
            points = points + step
            if float(xp.abs(step).max()) <= STEP_THRESHOLD_MM:
                break
        return points, xp.linalg.inv(rows.transpose(0, 2, 1) @ rows)

    return solve


def in_blocks(solve: Callable[[Any], Any], block: int) -> Callable[[Array], tuple[Array, Array]]:
    """Return the method applied to blocks of points that fit into the cache."""

    def all_of_them(readings: Array) -> tuple[Array, Array]:
        parts = [solve(readings[at : at + block]) for at in range(0, len(readings), block)]
        return np.concatenate([p for p, _ in parts]), np.concatenate([v for _, v in parts])

    return all_of_them


def numba_method(task: Task) -> Callable[[Array], tuple[Array, Array, NDArray[np.int64]]] | None:
    """Return our own algorithm in numba's parallel loop; None where numba is not installed.

    It returns positions, covariances, and how often each point's equations were set up.
    """
    try:
        import numba
    except ImportError:
        return None
    table, cameras = task.corrections, task.cameras
    sensors, degree = len(cameras), int(table.degree)
    values = np.ascontiguousarray(np.moveaxis(table.coefficients_px, 0, -1))
    variances = np.ascontiguousarray(np.moveaxis(table.variance_px2, 0, -1))
    origin, pitch = np.array(table.grid.origin_mm), np.array(table.grid.pitch_mm)
    cells = np.array(table.grid.cells)
    along = np.concatenate([cameras.rotation[:, 0], cameras.offset_mm[:, :1]], axis=1)
    depth = np.concatenate([cameras.rotation[:, 2], cameras.offset_mm[:, 2:]], axis=1)
    c, p0 = cameras.principal_distance_px, cameras.principal_point_px
    own = task.sigma_px**2
    jit = numba.njit(fastmath=False, error_model="numpy")

    @jit
    def basis(t: Any, w: Any, d: Any) -> None:
        s = 1.0 - t
        if degree == 1:
            w[0], w[1], d[0], d[1] = s, t, -1.0, 1.0
        else:
            w[0], w[3] = s * s * s / 6.0, t * t * t / 6.0
            w[1] = (4.0 - 6.0 * t * t + 3.0 * t * t * t) / 6.0
            w[2] = (4.0 - 6.0 * s * s + 3.0 * s * s * s) / 6.0
            d[0], d[3] = -0.5 * s * s, 0.5 * t * t
            d[1], d[2] = 1.5 * t * t - 2.0 * t, 2.0 * s - 1.5 * s * s

    @jit
    def locate(x: Any, cell: Any, t: Any) -> None:
        for axis in range(3):
            at = min(max((x[axis] - origin[axis]) / pitch[axis], 0.0), float(cells[axis]))
            cell[axis] = min(int(at), cells[axis] - 1)
            t[axis] = at - cell[axis]

    @jit
    def gram_at(x: Any, q: Any, variance: Any, work: Any, cell: Any, gram: Any) -> None:
        t, w, d, v = work[0], work[1:4], work[4:7], work[7:11]
        locate(x, cell, t)
        for axis in range(3):
            basis(t[axis], w[axis], d[axis])
        v[:] = 0.0
        for i in range(degree + 1):
            for j in range(degree + 1):
                for k in range(degree + 1):
                    w0 = w[0, i] * w[1, j] * w[2, k]
                    wx, wy = d[0, i] * w[1, j] * w[2, k], w[0, i] * d[1, j] * w[2, k]
                    wz = w[0, i] * w[1, j] * d[2, k]
                    for s in range(sensors):
                        node = values[cell[0] + i, cell[1] + j, cell[2] + k, s]
                        v[0, s] += w0 * node
                        v[1, s] += wx * node
                        v[2, s] += wy * node
                        v[3, s] += wz * node
        gram[:] = 0.0
        for s in range(sensors):
            a, b = along[s], depth[s]
            z = b[0] * x[0] + b[1] * x[1] + b[2] * x[2] + b[3]
            u = (a[0] * x[0] + a[1] * x[1] + a[2] * x[2] + a[3]) / z
            gain, weight = c[s] / z, 1.0 / variance[s]
            g0 = gain * (a[0] - u * b[0]) - v[1, s] / pitch[0]
            g1 = gain * (a[1] - u * b[1]) - v[2, s] / pitch[1]
            g2 = gain * (a[2] - u * b[2]) - v[3, s] / pitch[2]
            add(gram, g0, g1, g2, q[s] + v[0, s] - p0[s] - c[s] * u, weight)

    @jit
    def add(gram: Any, g0: Any, g1: Any, g2: Any, r: Any, weight: Any) -> None:
        gram[0] += weight * g0 * g0
        gram[1] += weight * g1 * g0
        gram[2] += weight * g1 * g1
        gram[3] += weight * g2 * g0
        gram[4] += weight * g2 * g1
        gram[5] += weight * g2 * g2
        gram[6] += weight * g0 * r
        gram[7] += weight * g1 * r
        gram[8] += weight * g2 * r
        gram[9] += weight * r * r

    @jit
    def adjugate(a: Any, m: Any) -> Any:
        m[0] = a[2] * a[5] - a[4] * a[4]
        m[1] = a[3] * a[4] - a[1] * a[5]
        m[2] = a[0] * a[5] - a[3] * a[3]
        m[3] = a[1] * a[4] - a[3] * a[2]
        m[4] = a[1] * a[3] - a[0] * a[4]
        m[5] = a[0] * a[2] - a[1] * a[1]
        return a[0] * m[0] + a[1] * m[1] + a[3] * m[3]

    @jit
    def step_of(gram: Any, m: Any, step: Any) -> None:
        scale = 1.0 / adjugate(gram, m)
        step[0] = (m[0] * gram[6] + m[1] * gram[7] + m[3] * gram[8]) * scale
        step[1] = (m[1] * gram[6] + m[2] * gram[7] + m[4] * gram[8]) * scale
        step[2] = (m[3] * gram[6] + m[4] * gram[7] + m[5] * gram[8]) * scale

    def every(readings: Any) -> Any:
        count = len(readings)
        found, spread = np.empty((count, 3)), np.empty((count, 3, 3))
        turns = np.zeros(count, np.int64)
        for n in numba.prange(count):
            work, cell = np.empty((11, max(4, sensors))), np.empty(3, np.int64)
            gram, there, m = np.zeros(10), np.empty(10), np.empty(6)
            x, trial, step = np.empty(3), np.empty(3), np.empty(3)
            variance, q = np.full(sensors, own), readings[n]
            for s in range(sensors):
                a, b, apart = along[s], depth[s], p0[s] - q[s]
                add(gram, c[s] * a[0] + apart * b[0], c[s] * a[1] + apart * b[1],
                    c[s] * a[2] + apart * b[2], -c[s] * a[3] - apart * b[3], 1.0)  # fmt: skip
            step_of(gram, m, x)
            # Two steps, then the table's variance at the place, then on to the end.
            for last in range(2):
                gram_at(x, q, variance, work, cell, gram)
                turns[n] += 1
                for _ in range(30 if last else 2):
                    step_of(gram, m, step)
                    for axis in range(3):
                        trial[axis] = x[axis] + step[axis]
                    gram_at(trial, q, variance, work, cell, there)
                    turns[n] += 1
                    if there[9] <= gram[9] * (1.0 + 1e-10):
                        x[:] = trial
                        gram[:] = there
                    if max(abs(step[0]), abs(step[1]), abs(step[2])) <= 1e-6:
                        break
                if not last:
                    locate(x, cell, work[0])
                    for s in range(sensors):
                        for corner in range(8):
                            i, j, k = corner >> 2, corner >> 1 & 1, corner & 1
                            w = work[0, 0] if i else 1.0 - work[0, 0]
                            w *= work[0, 1] if j else 1.0 - work[0, 1]
                            w *= work[0, 2] if k else 1.0 - work[0, 2]
                            variance[s] += w * variances[cell[0] + i, cell[1] + j, cell[2] + k, s]
            scale = 1.0 / adjugate(gram, m)
            spread[n, 0, 0], spread[n, 1, 1], spread[n, 2, 2] = m[0], m[2], m[5]
            spread[n, 0, 1] = spread[n, 1, 0] = m[1]
            spread[n, 0, 2] = spread[n, 2, 0] = m[3]
            spread[n, 1, 2] = spread[n, 2, 1] = m[4]
            spread[n] *= scale
            found[n] = x
        return found, spread, turns

    compiled: Callable[[Array], tuple[Array, Array, NDArray[np.int64]]] = numba.njit(
        parallel=True, error_model="numpy"
    )(every)
    return compiled
