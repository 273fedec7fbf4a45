"""Metric upgrade of a projective reconstruction by known lengths."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from compute.calibration.self_calibration.projective_reconstruction import ProjectiveReconstruction
from compute.calibration.single_sensor.projective_camera import metric_cameras, metric_models
from compute.camera.model import SensorGeometry, SensorModel

Array = NDArray[np.float64]

PLANE_SAMPLES: Final = 3000
"""Number of planes at infinity that are sampled."""
MAX_REFINED_PLANES: Final = 12
"""Number of sampled planes, the best first, that are refined."""
MAX_REFINED_PER_SIZE: Final = 3
"""Number of refined planes with a principal distance in the same bin of its logarithm."""
SIZE_BIN: Final = 0.4
MAX_PAIRS: Final = 150
"""Known lengths that judge a plane; more cost time and tell little more."""
DISTINCT_CAMERA_THRESHOLD: Final = 0.03
"""Relative difference of the camera matrices from which two upgrades are different."""
MAX_BEHIND: Final = 0.1
"""Share of points that may lie beyond the plane at infinity: those of wrong readings, unnoticed
where only three sensors read a marker; 1 % of wrong readings make 3 % of such points wrong."""
LENGTH_SIGMA: Final = 0.1
"""Relative misfit of a length that is usual before the metric adjustment."""
POINT_SIGMA: Final = 0.15
"""Standard deviation of principal points from the middle of the pixels, relative to these."""
DISTANCE_SIGMA: Final = 0.2
"""Relative standard deviation of the principal distances of one device from one another."""
USUAL_DISTANCE: Final = 1.2
"""Principal distance over the number of pixels: half a field of 23 degrees."""
USUAL_SIGMA: Final = 0.6
"""Standard deviation of its logarithm: half fields from 8 to 50 degrees are within two."""
BEHIND_MISFIT: Final = 10.0
"""Misfit of a length with an end beyond the plane at infinity."""
SEED: Final = 1


@dataclass(frozen=True, eq=False)
class _QuasiAffine:
    """Points in a frame whose plane at infinity does not cut them, centred and whitened.

    Args:
        position: shape (N, 3).
        homography: from the projective frame to this one, shape (4, 4).
    """

    position: Array
    homography: Array


def metric_upgrades(
    reconstruction: ProjectiveReconstruction,
    pairs: NDArray[np.intp],
    length_mm: Array,
    sensors: Sequence[SensorGeometry],
    seed: int = SEED,
) -> list[tuple[float, tuple[SensorModel, ...]]]:
    """Return metric cameras that nearly keep known lengths, with their costs, the best first.

    The plane at infinity, (v, 1) in a frame where it does not cut the points, lies in the polytope
    ``1 + v . Y > 0`` of the points Y; for a given v the squared lengths are linear in a symmetric
    3 x 3 matrix. v is sampled over the polytope, and the best samples are refined.

    Args:
        reconstruction: cameras, and points of known distances.
        pairs: indices of the ends of known lengths, shape (M, 2).
        length_mm: their lengths, shape (M,) [mm].
        sensors: names and pixels of the S cameras.
        seed: of the samples.

    Returns:
        Distinct solutions; none where points cannot lie in front of all cameras.
    """
    space = _quasi_affine(reconstruction)
    if space is None:
        return []
    rng = np.random.default_rng(seed)
    if len(pairs) > MAX_PAIRS:
        chosen = np.sort(rng.choice(len(pairs), MAX_PAIRS, replace=False))
        pairs, length_mm = pairs[chosen], length_mm[chosen]
    first, second = space.position[pairs[:, 0]], space.position[pairs[:, 1]]
    planes = _sample_planes(space.position, rng)
    start = reconstruction.cameras @ np.linalg.inv(space.homography)
    pixels = np.array([sensor.pixels for sensor in sensors], dtype=np.float64)
    costs, gram = _judge_planes(planes, first, second, length_mm)
    lens_costs, size = _lens_cost(start, planes, gram, pixels)
    found: list[tuple[float, Array, Array]] = []
    for index in _best_of_each_size(costs + lens_costs, size):
        upgrade = _refine(planes[index], gram[index], (first, second), length_mm, start, pixels)
        if upgrade is None:
            continue
        cost, plane, shape = upgrade
        if (1.0 + space.position @ plane <= 0.0).mean() > MAX_BEHIND:
            continue
        cameras = _upgraded(start, plane, shape)
        middle = np.median(
            space.position @ shape.T / (1.0 + space.position @ plane)[:, None], axis=0
        )
        found.append((cost, cameras, middle))
    found.sort(key=lambda one: one[0])
    distinct: list[Array] = []
    solutions = []
    for cost, cameras, middle in found:
        inner = _inner_parameters(cameras)
        signature = np.concatenate([np.log(inner[0]), inner[1] / inner[0]])
        if all(np.abs(signature - other).max() > DISTINCT_CAMERA_THRESHOLD for other in distinct):
            distinct.append(signature)
            seen = np.broadcast_to(middle, (len(sensors), 3))
            models = metric_models(metric_cameras(cameras, sensors, seen), sensors)
            solutions.append((cost, models))
    return solutions


def _quasi_affine(reconstruction: ProjectiveReconstruction) -> _QuasiAffine | None:
    depth = reconstruction.points @ reconstruction.cameras[:, 1].T
    # Signs of cameras and points that make all depths positive, by alternation.
    camera_sign = np.sign(depth[0]) + (depth[0] == 0.0)
    for _ in range(10):
        point_sign = np.where((np.sign(depth) * camera_sign).sum(axis=1) < 0.0, -1.0, 1.0)
        camera_sign = np.where((np.sign(depth) * point_sign[:, None]).sum(axis=0) < 0.0, -1.0, 1.0)
    positive = (depth * camera_sign * point_sign[:, None] > 0.0).all(axis=1)
    if positive.mean() < 0.8:
        return None
    planes = reconstruction.cameras[:, 1] * camera_sign[:, None]
    infinity = (planes / np.linalg.norm(planes, axis=1, keepdims=True)).sum(axis=0)
    basis = np.linalg.svd(infinity[None])[2][1:]
    homography = np.concatenate([basis, infinity[None]])
    moved = reconstruction.points @ homography.T
    position = moved[:, :3] / moved[:, 3:]
    good = position[positive]
    centre = np.median(good, axis=0)
    spread = np.median(np.abs(good - centre), axis=0).max() * 10.0
    inlying = good[np.abs(good - centre).max(axis=1) < spread]
    centre = inlying.mean(axis=0)
    covariance = np.cov((inlying - centre).T)
    values, vectors = np.linalg.eigh(covariance)
    whiten = np.eye(4)
    whiten[:3, :3] = (vectors / np.sqrt(np.maximum(values, 1e-12 * values[-1]))).T
    whiten[:3, 3] = -whiten[:3, :3] @ centre
    return _QuasiAffine((position - centre) @ whiten[:3, :3].T, whiten @ homography)


def _sample_planes(position: Array, rng: np.random.Generator) -> Array:
    """Return v over the polytope ``1 + v . Y > 0``, shape (PLANE_SAMPLES, 3)."""
    direction = rng.standard_normal((PLANE_SAMPLES, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    farthest = np.quantile(-(direction @ position.T), 1.0 - MAX_BEHIND, axis=1)
    reach = 1.0 / np.maximum(farthest, 1e-9)
    radius = np.cbrt(rng.random(PLANE_SAMPLES)) * 0.98
    return np.asarray(direction * (radius * reach)[:, None])


def _judge_planes(
    planes: Array, first: Array, second: Array, length_mm: Array
) -> tuple[Array, Array]:
    """Return the cost of the squared lengths for each plane (V,), and the forms (V, 3, 3)."""
    depth = [1.0 + planes @ one.T for one in (first, second)]
    behind = (depth[0] <= 0.0) | (depth[1] <= 0.0)
    ends = [
        one / np.where(behind, 1.0, down)[..., None]
        for one, down in zip((first, second), depth, strict=True)
    ]
    x, y, z = np.moveaxis((ends[0] - ends[1]) / length_mm[:, None], -1, 0)
    products = np.stack([x * x, y * y, z * z, 2 * x * y, 2 * y * z, 2 * z * x], axis=-1)
    weight = 1.0 * ~behind
    for _ in range(3):
        weighted = products * weight[..., None]
        normal = weighted.transpose(0, 2, 1) @ products
        scale = np.sqrt(np.einsum("vii->vi", normal)) + 1e-300
        normal = normal / (scale[:, :, None] * scale[:, None]) + 1e-10 * np.eye(6)
        right = weighted.sum(axis=1) / scale
        form = np.linalg.solve(normal, right[..., None])[..., 0] / scale
        residual = np.einsum("vbk,vk->vb", products, form) - 1.0
        size = np.where(behind, np.inf, np.abs(residual))
        median = np.median(size, axis=1, keepdims=True)
        weight = ~behind / np.maximum(1.0, size / (3.0 * median + 1e-12))
    xx, yy, zz, xy, yz, zx = form.T
    gram = np.stack([xx, xy, zx, xy, yy, yz, zx, yz, zz], axis=1).reshape(-1, 3, 3)
    # Squares of lengths have twice their relative misfit.
    misfit = np.where(behind, BEHIND_MISFIT, residual / (2.0 * LENGTH_SIGMA))
    costs = 0.5 * np.log1p(misfit**2).sum(axis=1)
    values, vectors = np.linalg.eigh(gram)
    costs[values[:, 0] <= 0.0] += len(length_mm)
    values = np.maximum(values, 1e-4 * np.maximum(values[:, 2:], 1e-300))
    return costs, (vectors * values[:, None]) @ vectors.transpose(0, 2, 1)


def _best_of_each_size(costs: Array, size: Array) -> list[int]:
    """Return indices of the best samples, of which few have lenses of about the same size.

    Few points fit lenses of several sizes: the lowest costs may all be near one of them.
    """
    taken: dict[int, int] = {}
    chosen = []
    for index in np.argsort(costs, kind="stable").tolist():
        bin_number = int(np.floor(size[index] / SIZE_BIN))
        if taken.get(bin_number, 0) < MAX_REFINED_PER_SIZE:
            taken[bin_number] = taken.get(bin_number, 0) + 1
            chosen.append(index)
        if len(chosen) == MAX_REFINED_PLANES:
            break
    return chosen


def _lens_cost(cameras: Array, planes: Array, gram: Array, pixels: Array) -> tuple[Array, Array]:
    """Return how unusual the lenses are with each plane and form, (V,), as ``_refine`` counts it.

    Second, the logarithm of their mean principal distance over the pixels, (V,).

    Products of rows of upgraded cameras need no more than the form: ``a A^-1 A^-T b = a G^-1 b``.
    """
    rows = cameras[None, ..., :3] - cameras[None, ..., 3:] * planes[:, None, None]
    products = rows @ np.linalg.inv(gram)[:, None] @ rows.swapaxes(2, 3)
    point = products[..., 0, 1] / products[..., 1, 1]
    distance = np.sqrt(np.maximum(products[..., 0, 0] / products[..., 1, 1] - point**2, 0.0))
    size = np.log(np.maximum(distance, 1e-9) / pixels).mean(axis=1)
    costs = 0.5 * np.log1p(_lens_misfits(distance, point, pixels) ** 2).sum(axis=-1)
    return costs, size


def _lens_misfits(distance: Array, point: Array, pixels: Array) -> Array:
    """Return misfits (..., 2 S + 1), over sigma, to lenses that are alike, centred and usual.

    With few points or weak perspective several upgrades keep the lengths.

    Args:
        distance: principal distances, shape (..., S) [px].
        point: principal points, shape (..., S) [px].
        pixels: of the sensors, shape (S,).
    """
    size = np.log(np.maximum(distance, 1e-9) / pixels)
    mean = size.mean(axis=-1, keepdims=True)
    usual = (mean - np.log(USUAL_DISTANCE)) / USUAL_SIGMA
    centred = (point - 0.5 * (pixels - 1.0)) / (POINT_SIGMA * pixels)
    return np.concatenate([(size - mean) / DISTANCE_SIGMA, centred, usual], axis=-1)


def _refine(
    plane: Array,
    gram: Array,
    ends: tuple[Array, Array],
    length_mm: Array,
    cameras: Array,
    pixels: Array,
) -> tuple[float, Array, Array] | None:
    """Return cost, plane (3,) and upper triangular shape (3, 3) near a start; None without one.

    The cost is of the lengths' misfits and those of the lenses, each over its standard deviation.
    """
    try:
        shape = np.linalg.cholesky(gram).T
    except np.linalg.LinAlgError:
        return None
    upper = np.triu_indices(3)

    def misfits(unknowns: Array) -> Array:
        matrix = np.zeros((3, 3))
        matrix[upper] = unknowns[3:]
        # Beyond the polytope the lengths are those just inside, a large misfit.
        scaled = [one / np.maximum(1.0 + one @ unknowns[:3], 1e-6)[:, None] for one in ends]
        length = np.linalg.norm((scaled[0] - scaled[1]) @ matrix.T, axis=1)
        misfit = np.log(np.maximum(length, 1e-9) / length_mm) / LENGTH_SIGMA
        inner = _inner_parameters(_upgraded(cameras, unknowns[:3], matrix))
        return np.concatenate([misfit, _lens_misfits(*inner, pixels)])

    try:
        solution = least_squares(
            misfits, np.concatenate([plane, shape[upper]]), loss="cauchy", max_nfev=40,
            x_scale=np.concatenate([np.full(3, 0.1), np.full(6, np.abs(shape).max() * 0.1)]),
        )  # fmt: skip
    except (ValueError, np.linalg.LinAlgError):
        return None
    matrix = np.zeros((3, 3))
    matrix[upper] = solution.x[3:]
    if not np.isfinite(solution.cost) or np.linalg.cond(matrix) > 1e6:
        return None
    return float(solution.cost), solution.x[:3], matrix


def _upgraded(cameras: Array, plane: Array, shape: Array) -> Array:
    """Return cameras (S, 2, 4) in the frame in which points Y are at ``shape Y / (1 + v Y)``."""
    upgrade = np.eye(4)
    upgrade[:3, :3], upgrade[3, :3] = shape, plane
    return np.asarray(cameras @ np.linalg.inv(upgrade))


def _inner_parameters(cameras: Array) -> tuple[Array, Array]:
    """Return principal distances and points of metric 2 x 4 matrices, both (S,) [px]."""
    normal = cameras[:, 1, :3]
    scale = np.linalg.norm(normal, axis=1)
    point = np.einsum("si,si->s", cameras[:, 0, :3], normal) / scale**2
    distance = np.linalg.norm(cameras[:, 0, :3] - point[:, None] * normal, axis=1) / scale
    return distance, point
