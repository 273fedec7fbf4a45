"""Projective cameras and points from readings alone: affine start, bundle adjustment, dual."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.robust_statistics import MAD_TO_SIGMA

Array = NDArray[np.float64]

SUBSETS: Final = 64
"""Random subsets of points, one of which is free of wrong readings."""
HALVES: Final = 16
"""Random halves of the points that are tried with four sensors."""
SUBSET_POINTS: Final = 14
SUBSET_ITERATIONS: Final = 15
SEED: Final = 1
MAX_ITERATIONS: Final = 150
CONVERGENCE_TOLERANCE: Final = 1e-7
"""Relative decrease of the loss that a step predicts at the end."""
MAX_DAMPING: Final = 1e10
CAUCHY_LIMIT: Final = 3.0
"""Misfit of a point over the median's sigma at which its weight is halved."""
WEIGHT_ROUNDS: Final = 4
MIN_READINGS: Final = 4
"""Readings of a point from which it constrains projective cameras."""


@dataclass(frozen=True, eq=False)
class ProjectiveReconstruction:
    """S projective 1D cameras and N points, up to a homography of space.

    Args:
        cameras: 2 x 4 matrices, ``p = (m1 . X) / (m2 . X)``, shape (S, 2, 4).
        points: homogeneous, shape (N, 4).
        readings: shape (N, S); NaN where not seen.
    """

    cameras: Array
    points: Array
    readings: Array

    def residuals(self) -> Array:
        """Return projected minus read, (N, S); 0 where not seen."""
        image = np.einsum("sij,nj->nsi", self.cameras, self.points)
        with np.errstate(divide="ignore", invalid="ignore"):
            difference = image[..., 0] / image[..., 1] - self.readings
        return np.where(np.isfinite(self.readings), difference, 0.0)

    def point_misfits(self) -> Array:
        """Return the RMS residual of each point over its degrees of freedom, (N,)."""
        dof = np.isfinite(self.readings).sum(axis=1) - 3
        squares = (self.residuals() ** 2).sum(axis=1)
        return np.asarray(np.sqrt(squares / np.maximum(dof, 1)))

    def balanced(self) -> "ProjectiveReconstruction":
        """Return the same reconstruction in a frame where the stacked cameras are orthonormal."""
        cameras = self.cameras / np.linalg.norm(self.cameras, axis=(1, 2), keepdims=True)
        orthonormal, upper = np.linalg.qr(cameras.reshape(-1, 4))
        points = self.points @ upper.T
        points = points / np.linalg.norm(points, axis=1, keepdims=True)
        return replace(self, cameras=orthonormal.reshape(-1, 2, 4), points=points)

    def triangulated(self, readings: Array) -> Array:
        """Triangulate linearly, with the cameras held.

        Args:
            readings: shape (N', S); NaN where not seen, at least three seen.

        Returns:
            Homogeneous points of norm 1, shape (N', 4).
        """
        seen = np.isfinite(readings)
        read = np.where(seen, readings, 0.0)[..., None]
        rows = read * self.cameras[:, 1] - self.cameras[:, 0]
        rows = rows * (seen / np.linalg.norm(self.cameras[:, 1], axis=1))[..., None]
        return np.asarray(np.linalg.svd(rows)[2][:, 3])


def reconstruct_projective(readings: Array) -> ProjectiveReconstruction:
    """Reconstruct projective cameras and points, whatever wrong readings there are.

    With four sensors a point has one redundant reading, which a wrong one may bend the cameras to
    agree with: random halves of the points are tried, of which some are free of wrong readings.

    Args:
        readings: shape (N, S), at least four seen of each point; NaN where not seen.
    """
    whole = adjust_projective(affine_start(readings))
    if readings.shape[1] > MIN_READINGS:
        return whole
    rng = np.random.default_rng(SEED)
    candidates = [whole]
    for _ in range(HALVES):
        half = readings[rng.permutation(len(readings))[: max(len(readings) // 2, SUBSET_POINTS)]]
        part = adjust_projective(affine_start(half))
        candidates.append(
            ProjectiveReconstruction(part.cameras, part.triangulated(readings), readings)
        )
    best = min(candidates, key=lambda one: float(np.median(one.point_misfits())))
    return whole if best is whole else adjust_projective(best)


def affine_start(readings: Array) -> ProjectiveReconstruction:
    """Factorise readings as those of affine cameras: the best of random subsets, then all points.

    For sensors that look the same way, p is nearly affine in (x/z, y/z, 1/z).

    Args:
        readings: shape (N, S), at least four seen of each point; NaN where not seen.
    """
    count = len(readings)
    rng = np.random.default_rng(SEED)
    subsets = np.array(
        [rng.permutation(count)[: min(SUBSET_POINTS, count)] for _ in range(SUBSETS)]
    )
    parts = readings[subsets]
    trials = _affine_cameras(parts, _first_cameras(parts), SUBSET_ITERATIONS)
    misfits = _affine_misfits(readings[None], trials)
    best = int(np.argmin(np.median(misfits, axis=1)))
    cameras = trials[best]
    for _ in range(WEIGHT_ROUNDS):
        weight = _point_weights(_affine_misfits(readings[None], cameras[None])[0])
        cameras = _affine_cameras(readings[None], cameras[None], SUBSET_ITERATIONS, weight)[0]
    points = np.column_stack([_affine_points(readings[None], cameras[None])[0], np.ones(count)])
    matrices = np.zeros((readings.shape[1], 2, 4))
    matrices[:, 0] = cameras
    matrices[:, 1, 3] = 1.0
    return ProjectiveReconstruction(matrices, points, readings)


def _first_cameras(readings: Array) -> Array:
    """Return affine cameras (T, S, 4) of readings (T, N, S), missing ones at their mean."""
    seen = np.isfinite(readings)
    total = np.where(seen, readings, 0.0).sum(axis=1)
    mean = total / np.maximum(seen.sum(axis=1), 1)
    filled = np.where(seen, readings - mean[:, None], 0.0)
    _, singular, right = np.linalg.svd(filled, full_matrices=False)
    rows = singular[:, :3, None] * right[:, :3] / np.sqrt(readings.shape[1])
    return np.concatenate([rows.transpose(0, 2, 1), mean[..., None]], axis=2)


def _affine_points(readings: Array, cameras: Array) -> Array:
    """Return points (T, N, 3) of readings (T, N, S) with affine cameras (T, S, 4)."""
    seen = np.isfinite(readings)
    target = np.where(seen, readings - cameras[:, None, :, 3], 0.0)
    rows = cameras[..., :3]
    normal = np.einsum("tns,tsi,tsj->tnij", seen, rows, rows, optimize=True)
    trace = np.trace(normal, axis1=2, axis2=3)[..., None, None]
    # Slightly regularised: missing readings must not send a point away.
    normal = normal + 1e-9 * (trace + np.finfo(np.float64).tiny) * np.eye(3)
    return np.asarray(np.linalg.solve(normal, (target @ rows)[..., None])[..., 0])


def _affine_misfits(readings: Array, cameras: Array) -> Array:
    """Return each point's RMS residual over its degrees of freedom, (T, N)."""
    seen = np.isfinite(readings)
    points = _affine_points(readings, cameras)
    predicted = points @ cameras[..., :3].transpose(0, 2, 1) + cameras[:, None, :, 3]
    squares = (np.where(seen, predicted - readings, 0.0) ** 2).sum(axis=2)
    return np.asarray(np.sqrt(squares / np.maximum(seen.sum(axis=2) - 3, 1)))


def _affine_cameras(
    readings: Array, cameras: Array, iterations: int, weight: Array | None = None
) -> Array:
    """Refine affine cameras (T, S, 4) by alternating least squares."""
    seen = np.isfinite(readings)
    known = seen * (1.0 if weight is None else weight[:, None])
    target = np.where(seen, readings, 0.0) * known
    for _ in range(iterations):
        points = _affine_points(readings, cameras)
        points = np.concatenate([points, np.ones((*points.shape[:2], 1))], axis=2)
        normal = np.einsum("tns,tni,tnj->tsij", known, points, points, optimize=True)
        trace = np.trace(normal, axis1=2, axis2=3)[..., None, None]
        normal = normal + 1e-12 * (trace + np.finfo(np.float64).tiny) * np.eye(4)
        right = target.transpose(0, 2, 1) @ points
        cameras = np.linalg.solve(normal, right[..., None])[..., 0]
    return cameras


def adjust_projective(start: ProjectiveReconstruction) -> ProjectiveReconstruction:
    """Adjust cameras and points by Levenberg-Marquardt, points eliminated, outliers weighted down.

    Args:
        start: cameras and points; points in which readings disagree get a small weight.
    """
    current = start.balanced()
    for _ in range(WEIGHT_ROUNDS):
        weight = _point_weights(current.point_misfits())
        current = _minimise(current, weight)
    return current


def dual(reconstruction: ProjectiveReconstruction) -> ProjectiveReconstruction:
    """Return the other four cameras with the same quadrifocal tensor, with points.

    Four readings meet in a point where ``det(W' A) = 0``, A the stacked 8 x 4 cameras and W the
    readings' normals (-1, p). The complement of A meets the same condition with (p, 1).

    Args:
        reconstruction: of four cameras.
    """
    stacked = reconstruction.cameras.reshape(-1, 4)
    complement = np.linalg.svd(stacked)[0][:, 4:].reshape(4, 2, 4)
    cameras = np.stack([-complement[:, 1], complement[:, 0]], axis=1)
    swapped = replace(reconstruction, cameras=cameras)
    points = swapped.triangulated(reconstruction.readings)
    return replace(swapped, points=points).balanced()


def _point_weights(misfit: Array) -> Array:
    sigma = MAD_TO_SIGMA * float(np.median(misfit)) + np.finfo(np.float64).tiny
    return np.asarray(1.0 / (1.0 + (misfit / (CAUCHY_LIMIT * sigma)) ** 2))


def _minimise(current: ProjectiveReconstruction, weight: Array) -> ProjectiveReconstruction:
    seen = np.isfinite(current.readings)
    count = current.readings.shape[1]
    loss = _loss(current, weight)
    damping = 1e-3
    for _ in range(MAX_ITERATIONS):
        image = np.einsum("sij,nj->nsi", current.cameras, current.points)
        root = np.sqrt(weight)[:, None] * seen
        residual = root * np.where(seen, current.residuals(), 0.0)
        by_first = root / image[..., 1]
        by_second = -by_first * image[..., 0] / image[..., 1]
        by_point = (
            by_first[..., None] * current.cameras[:, 0]
            + by_second[..., None] * current.cameras[:, 1]
        )
        by_camera = np.concatenate(
            [
                by_first[..., None] * current.points[:, None],
                by_second[..., None] * current.points[:, None],
            ],
            axis=2,
        )
        point_normal = np.einsum("nsi,nsj->nij", by_point, by_point)
        trace = np.trace(point_normal, axis1=1, axis2=2)[:, None, None]
        # The length of a point is free: hold it.
        point_normal += (damping * np.eye(4) + np.einsum("ni,nj->nij", *(2 * [current.points]))) * (
            trace + np.finfo(np.float64).tiny
        )
        camera_normal = np.einsum("nsi,nsj->sij", by_camera, by_camera)
        mixed = np.einsum("nsi,nsj->nsij", by_camera, by_point).reshape(-1, 8 * count, 4)
        inverse = np.linalg.inv(point_normal)
        point_gradient = np.einsum("nsi,ns->ni", by_point, residual)
        camera_gradient = np.einsum("nsi,ns->si", by_camera, residual).ravel()
        eliminated = mixed @ inverse
        flat = eliminated.transpose(1, 0, 2).reshape(8 * count, -1)
        normal = -flat @ mixed.transpose(1, 0, 2).reshape(8 * count, -1).T
        for sensor in range(count):
            block = slice(8 * sensor, 8 * sensor + 8)
            normal[block, block] += camera_normal[sensor]
        scale = np.trace(camera_normal, axis1=1, axis2=2).mean() / 8.0
        normal += damping * scale * np.eye(8 * count)
        right = -(camera_gradient - np.einsum("nij,nj->i", eliminated, point_gradient))
        step = np.linalg.lstsq(normal, right, rcond=1e-14)[0]
        point_step = -np.einsum(
            "nij,nj->ni", inverse, point_gradient + np.einsum("nij,i->nj", mixed, step)
        )
        predicted = -float(camera_gradient @ step + (point_gradient * point_step).sum())
        trial = replace(
            current,
            cameras=current.cameras + step.reshape(-1, 2, 4),
            points=current.points + point_step,
        )
        new = _loss(trial, weight)
        ending = predicted <= CONVERGENCE_TOLERANCE * loss and damping < 1e-2
        if new < loss:
            current, loss, damping = trial.balanced(), new, max(0.2 * damping, 1e-12)
        else:
            damping *= 5.0
        if ending or damping > MAX_DAMPING:
            break
    return current


def _loss(reconstruction: ProjectiveReconstruction, weight: Array) -> float:
    value = float((weight[:, None] * reconstruction.residuals() ** 2).sum())
    return value if np.isfinite(value) else np.inf
