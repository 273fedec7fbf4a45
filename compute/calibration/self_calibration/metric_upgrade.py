"""Metric upgrade of a projective reconstruction by known lengths."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from compute.calibration.self_calibration.projective_reconstruction import ProjectiveReconstruction
from compute.camera.model import SensorGeometry, SensorModel, vector3

Array = NDArray[np.float64]

SAMPLES: Final = 3000
"""Planes at infinity that are tried."""
REFINED: Final = 12
"""The best of them that are refined."""
MAX_PAIRS: Final = 150
"""Known lengths that judge a plane; more cost time and tell little more."""
DISTINCT: Final = 0.03
"""Relative difference of the camera matrices from which two upgrades are different."""
MAX_BEHIND: Final = 0.02
"""Share of points that may lie beyond the plane at infinity: those of unnoticed wrong readings."""
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


def metric_cameras(
    reconstruction: ProjectiveReconstruction,
    pairs: NDArray[np.intp],
    length_mm: Array,
    sensors: Sequence[SensorGeometry],
) -> list[tuple[SensorModel, ...]]:
    """Return metric cameras that nearly keep known lengths, the best first.

    The plane at infinity, (v, 1) in a frame where it does not cut the points, lies in the polytope
    ``1 + v . Y > 0`` of the points Y; for a given v the squared lengths are linear in a symmetric
    3 x 3 matrix. v is sampled over the polytope, and the best samples are refined.

    Args:
        reconstruction: cameras, and points of known distances.
        pairs: indices of the ends of known lengths, shape (M, 2).
        length_mm: their lengths, shape (M,) [mm].
        sensors: names and pixels of the S cameras.

    Returns:
        Distinct solutions; none where points cannot lie in front of all cameras.
    """
    space = _quasi_affine(reconstruction)
    if space is None:
        return []
    rng = np.random.default_rng(SEED)
    if len(pairs) > MAX_PAIRS:
        chosen = np.sort(rng.choice(len(pairs), MAX_PAIRS, replace=False))
        pairs, length_mm = pairs[chosen], length_mm[chosen]
    first, second = space.position[pairs[:, 0]], space.position[pairs[:, 1]]
    planes = _sample_planes(space.position, rng)
    costs, gram = _judge_planes(planes, first, second, length_mm)
    found: list[tuple[float, Array]] = []
    for index in np.argsort(costs, kind="stable")[:REFINED]:
        refined = _refine(planes[index], gram[index], first, second, length_mm)
        if refined is None or (1.0 + space.position @ refined[1] <= 0.0).mean() > MAX_BEHIND:
            continue
        cost, plane, shape = refined
        upgrade = np.eye(4)
        upgrade[:3, :3], upgrade[3, :3] = shape, plane
        cameras = reconstruction.cameras @ np.linalg.inv(upgrade @ space.homography)
        moved = np.column_stack([space.position, np.ones(len(space.position))]) @ upgrade.T
        depth = (moved[:, :3] / moved[:, 3:]) @ cameras[:, 1, :3].T + cameras[:, 1, 3]
        cameras = cameras * np.sign(np.median(depth, axis=0))[:, None, None]
        found.append((cost, cameras))
    found.sort(key=lambda one: one[0])
    distinct: list[Array] = []
    solutions = []
    for _, cameras in found:
        signature = _signature(cameras)
        if all(np.abs(signature - other).max() > DISTINCT for other in distinct):
            distinct.append(signature)
            solutions.append(
                tuple(_sensor_model(*one) for one in zip(cameras, sensors, strict=True))
            )
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
    """Return v over the polytope ``1 + v . Y > 0``, shape (SAMPLES, 3)."""
    direction = rng.standard_normal((SAMPLES, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    farthest = np.quantile(-(direction @ position.T), 1.0 - MAX_BEHIND, axis=1)
    reach = 1.0 / np.maximum(farthest, 1e-9)
    radius = np.cbrt(rng.random(SAMPLES)) * 0.98
    return np.asarray(direction * (radius * reach)[:, None])


def _judge_planes(
    planes: Array, first: Array, second: Array, length_mm: Array
) -> tuple[Array, Array]:
    """Return the misfit of the squared lengths for each plane (V,), and the forms (V, 3, 3)."""
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
    costs = np.minimum(size, 1.0).mean(axis=1)
    costs[np.linalg.eigvalsh(gram)[:, 0] <= 0.0] += 1.0
    return costs, gram


def _refine(
    plane: Array, gram: Array, first: Array, second: Array, length_mm: Array
) -> tuple[float, Array, Array] | None:
    """Return cost, plane (3,) and upper triangular shape (3, 3) near a start; None without one."""
    values, vectors = np.linalg.eigh(gram)
    values = np.maximum(values, 1e-4 * max(float(values[-1]), 1e-300))
    shape = np.linalg.cholesky((vectors * values) @ vectors.T).T
    upper = np.triu_indices(3)

    def misfits(unknowns: Array) -> Array:
        matrix = np.zeros((3, 3))
        matrix[upper] = unknowns[3:]
        below = (1.0 + first @ unknowns[:3], 1.0 + second @ unknowns[:3])
        # Beyond the polytope the lengths are those just inside, a large misfit.
        ends = [
            one / np.maximum(down, 1e-6)[:, None]
            for one, down in zip((first, second), below, strict=True)
        ]
        length = np.linalg.norm((ends[0] - ends[1]) @ matrix.T, axis=1)
        return np.asarray(np.log(np.maximum(length, 1e-9) / length_mm))

    solution = least_squares(
        misfits, np.concatenate([plane, shape[upper]]), loss="cauchy", f_scale=0.1, max_nfev=40,
        x_scale=np.concatenate([np.full(3, 0.1), np.full(6, np.abs(shape).max() * 0.1)]),
    )  # fmt: skip
    if not np.isfinite(solution.cost):
        return None
    matrix = np.zeros((3, 3))
    matrix[upper] = solution.x[3:]
    if np.linalg.cond(matrix) > 1e6:
        return None
    return float(solution.cost), solution.x[:3], matrix


def _signature(cameras: Array) -> Array:
    """Return what tells cameras apart whatever their frame: principal distances and points."""
    normal = cameras[:, 1, :3]
    scale = np.linalg.norm(normal, axis=1)
    point = np.einsum("si,si->s", cameras[:, 0, :3], normal) / scale**2
    distance = np.linalg.norm(cameras[:, 0, :3] - point[:, None] * normal, axis=1) / scale
    return np.concatenate([np.log(distance), point / distance])


def _sensor_model(camera: Array, sensor: SensorGeometry) -> SensorModel:
    """Return the metric sensor of a 2 x 4 matrix with positive depths."""
    second = camera[1] / np.linalg.norm(camera[1, :3])
    first = camera[0] / np.linalg.norm(camera[1, :3])
    forward = second[:3]
    point = float(first[:3] @ forward)
    along = first - point * second
    distance = float(np.linalg.norm(along[:3]))
    right = along[:3] / distance
    rotation = np.stack([right, np.cross(forward, right), forward])
    return SensorModel(
        sensor.name,
        sensor.pixels,
        distance,
        point,
        vector3(Rotation.from_matrix(rotation).as_rotvec()),
        float(along[3]) / distance,
        float(second[3]),
    )
