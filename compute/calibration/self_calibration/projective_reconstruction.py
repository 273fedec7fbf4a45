"""Projective cameras and points from readings alone: affine start, bundle adjustment, dual."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.robust_statistics import MAD_TO_SIGMA

Array = NDArray[np.float64]

TRIALS: Final = 64
"""Random subsets of points, some of which are free of wrong readings."""
FINISHED_TRIALS: Final = 3
"""The best of them, with four sensors, that are adjusted to all points."""
SUBSET_POINTS: Final = 16
SUBSET_ITERATIONS: Final = 15
SEED: Final = 1
MAX_ITERATIONS: Final = 40
PERSPECTIVE_SIGMA: Final = 0.1
"""Standard deviation of g: a sensor sees a point one standard deviation away 10 % nearer than
the others do."""
GAUGE_DAMPING: Final = 1e-9
"""Least damping, for the frame is free."""
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


def reconstruct_projective(readings: Array, seed: int = SEED) -> ProjectiveReconstruction:
    """Reconstruct projective cameras and points, robust against wrong readings.

    With four sensors a point has one redundant reading, which a wrong one may bend the cameras to
    agree with: random subsets of the points are tried, of which some are free of wrong readings.

    Args:
        readings: shape (N, S), at least four seen of each point; NaN where not seen.
        seed: of the subsets.
    """
    whole = adjust_projective(affine_start(readings, seed))
    if readings.shape[1] > MIN_READINGS or len(readings) <= SUBSET_POINTS:
        return whole
    parts = readings[_subsets(len(readings), TRIALS, seed)]
    affine = _affine_cameras(parts, _first_cameras(parts), SUBSET_ITERATIONS)
    state = _PerspectiveState.of_affine(affine, _affine_points(parts, affine), parts)
    misfits = []
    trials = []
    for one in state.adjusted().matrices():
        trial = ProjectiveReconstruction(one, np.zeros((0, 4)), readings)
        trial = replace(trial, points=trial.triangulated(readings))
        trials.append(trial)
        misfits.append(float(np.median(trial.point_misfits())))
    best = [trials[index] for index in np.argsort(misfits, kind="stable")[:FINISHED_TRIALS]]
    return min([whole, *map(adjust_projective, best)], key=_robust_misfit)


def _robust_misfit(reconstruction: ProjectiveReconstruction) -> float:
    return float(np.median(reconstruction.point_misfits()))


def _subsets(count: int, trials: int, seed: int) -> NDArray[np.intp]:
    rng = np.random.default_rng(seed)
    size = min(SUBSET_POINTS, count)
    return np.array([rng.permutation(count)[:size] for _ in range(trials)])


def affine_start(readings: Array, seed: int = SEED) -> ProjectiveReconstruction:
    """Factorise readings as those of affine cameras: the best of random subsets, then all points.

    For sensors that look the same way, p is nearly affine in (x/z, y/z, 1/z).

    Args:
        readings: shape (N, S), at least four seen of each point; NaN where not seen.
        seed: of the subsets.
    """
    count = len(readings)
    parts = readings[_subsets(count, TRIALS, seed)]
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
        start: cameras and points in a frame whose plane at infinity does not cut the points;
            points in which readings disagree get a small weight.
    """
    frame = start.points[:, :3] / start.points[:, 3:]
    scale = start.cameras[:, 1, 3]
    state = _PerspectiveState(
        (start.cameras[:, 0] / scale[:, None])[None],
        (start.cameras[:, 1, :3] / scale[:, None])[None],
        frame[None],
        start.readings[None],
    )
    state = state.adjusted()
    points = np.column_stack([state.points[0], np.ones(len(frame))])
    return ProjectiveReconstruction(state.matrices()[0], points, start.readings)


@dataclass(frozen=True, eq=False)
class _PerspectiveState:
    """T trials of S cameras ``p = (a . Y + b) / (1 + g . Y)`` and N points each.

    Affine cameras have g = 0; with whitened points it is how much the depths seen by a sensor
    differ from the others'. A weak prior holds g near 0, where few points leave it open.

    Args:
        numerator: (a, b), shape (T, S, 4).
        perspective: g, shape (T, S, 3).
        points: Y, shape (T, N, 3).
        readings: shape (T, N, S); NaN where not seen.
    """

    numerator: Array
    perspective: Array
    points: Array
    readings: Array

    @classmethod
    def of_affine(cls, cameras: Array, points: Array, readings: Array) -> "_PerspectiveState":
        return cls(cameras, np.zeros((*cameras.shape[:2], 3)), points, readings)

    def matrices(self) -> Array:
        """Return the cameras, shape (T, S, 2, 4)."""
        ones = np.ones((*self.perspective.shape[:2], 1))
        second = np.concatenate([self.perspective, ones], axis=2)
        return np.stack([self.numerator, second], axis=2)

    def depths(self) -> Array:
        """Return ``1 + g . Y``, shape (T, N, S)."""
        return np.asarray(1.0 + self.points @ self.perspective.swapaxes(1, 2))

    def residuals(self) -> Array:
        """Return projected minus read, shape (T, N, S); 0 where not seen."""
        first = self.points @ self.numerator[..., :3].swapaxes(1, 2) + self.numerator[:, None, :, 3]
        difference = first / self.depths() - self.readings
        return np.where(np.isfinite(self.readings), difference, 0.0)

    def adjusted(self) -> "_PerspectiveState":
        """Minimise the weighted squares; weights and noise follow from the last residuals."""
        state = self
        dof = np.maximum(np.isfinite(self.readings).sum(axis=2) - 3, 1)
        for _ in range(WEIGHT_ROUNDS):
            squares = (state.residuals() ** 2).sum(axis=2) / dof
            sigma = MAD_TO_SIGMA * np.sqrt(np.median(squares, axis=1, keepdims=True)) + 1e-9
            weight = 1.0 / (1.0 + squares / (CAUCHY_LIMIT * sigma) ** 2)
            state = _minimise(state.whitened(weight), weight, sigma[:, 0] ** 2)
        return state

    def whitened(self, weight: Array) -> "_PerspectiveState":
        """Return the same state with points of mean 0 and covariance 1, by weights (T, N)."""
        share = weight / weight.sum(axis=1, keepdims=True)
        centre = np.einsum("tn,tni->ti", share, self.points)
        away = self.points - centre[:, None]
        covariance = np.einsum("tn,tni,tnj->tij", share, away, away)
        values, vectors = np.linalg.eigh(covariance)
        floor = 1e-12 * values[:, 2:] + np.finfo(np.float64).tiny
        spread = vectors * np.sqrt(np.maximum(values, floor))[:, None]
        points = np.linalg.solve(spread, away.swapaxes(1, 2)).swapaxes(1, 2)
        depth = 1.0 + np.einsum("tsi,ti->ts", self.perspective, centre)
        constant = self.numerator[..., 3] + np.einsum("tsi,ti->ts", self.numerator[..., :3], centre)
        numerator = np.concatenate([self.numerator[..., :3] @ spread, constant[..., None]], axis=2)
        return _PerspectiveState(
            numerator / depth[..., None],
            (self.perspective @ spread) / depth[..., None],
            points,
            self.readings,
        )


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


def _minimise(state: _PerspectiveState, weight: Array, variance: Array) -> _PerspectiveState:
    """Run Levenberg-Marquardt on all trials, each with its own damping.

    Args:
        state: whitened.
        weight: of the points, shape (T, N).
        variance: of the readings, shape (T,), which weighs them beside the prior.
    """
    trials, _, sensors = state.readings.shape
    seen = np.isfinite(state.readings)
    root = np.sqrt(weight)[..., None] * seen
    prior = (variance / PERSPECTIVE_SIGMA**2)[:, None, None]
    diagonal = np.arange(7)
    damping = np.full(trials, 1e-3)
    loss = _loss(state, root, prior)
    active = np.ones(trials, dtype=np.bool_)
    for _ in range(MAX_ITERATIONS):
        depth = state.depths()
        residual = root * state.residuals()
        image = state.residuals() + np.where(seen, state.readings, 0.0)
        gain = (root / depth)[..., None]
        point = state.points[:, :, None]
        by_camera = np.concatenate(
            [gain * point, gain, -(gain * image[..., None]) * point], axis=3
        )  # (T, N, S, 7)
        by_point = gain * (
            state.numerator[:, None, :, :3] - image[..., None] * state.perspective[:, None]
        )
        point_normal = by_point.swapaxes(2, 3) @ by_point
        trace = np.trace(point_normal, axis1=2, axis2=3) + np.finfo(np.float64).tiny
        point_normal += (damping[:, None] * trace)[..., None, None] * np.eye(3)
        point_gradient = (by_point * residual[..., None]).sum(axis=2)
        swapped = by_camera.transpose(0, 2, 3, 1)  # (T, S, 7, N)
        camera_normal = swapped @ swapped.swapaxes(2, 3)
        camera_gradient = (swapped @ residual.transpose(0, 2, 1)[..., None])[..., 0]
        camera_gradient[..., 4:] += prior * state.perspective
        camera_normal[..., diagonal[4:], diagonal[4:]] += prior
        mixed = by_camera[..., None] * by_point[..., None, :]  # (T, N, S, 7, 3)
        mixed = mixed.reshape(*mixed.shape[:2], 7 * sensors, 3)
        inverse = np.linalg.inv(point_normal)
        eliminated = mixed @ inverse
        flat = eliminated.transpose(0, 2, 1, 3).reshape(trials, 7 * sensors, -1)
        normal = -flat @ mixed.transpose(0, 2, 1, 3).reshape(trials, 7 * sensors, -1).swapaxes(1, 2)
        size = np.trace(camera_normal, axis1=2, axis2=3).mean(axis=1) / 7.0
        for sensor in range(sensors):
            block = slice(7 * sensor, 7 * sensor + 7)
            normal[:, block, block] += camera_normal[:, sensor]
        normal += ((damping + GAUGE_DAMPING) * size)[:, None, None] * np.eye(7 * sensors)
        right = -camera_gradient.reshape(trials, -1)
        right += (flat @ point_gradient.reshape(trials, -1, 1))[..., 0]
        step = np.linalg.solve(normal, right[..., None])[..., 0]
        coupled = point_gradient + (mixed.swapaxes(2, 3) @ step[:, None, :, None])[..., 0]
        point_step = -(inverse @ coupled[..., None])[..., 0]
        predicted = -(camera_gradient.reshape(trials, -1) * step).sum(axis=1)
        predicted -= (point_gradient * point_step).sum(axis=(1, 2))
        by_sensor = step.reshape(trials, sensors, 7)
        trial = _PerspectiveState(
            state.numerator + by_sensor[..., :4],
            state.perspective + by_sensor[..., 4:],
            state.points + point_step,
            state.readings,
        )
        new = _loss(trial, root, prior)
        ending = (predicted <= CONVERGENCE_TOLERANCE * loss) & (damping < 1e-2)
        better = active & (new < loss)
        state = _PerspectiveState(
            np.where(better[:, None, None], trial.numerator, state.numerator),
            np.where(better[:, None, None], trial.perspective, state.perspective),
            np.where(better[:, None, None], trial.points, state.points),
            state.readings,
        )
        loss = np.where(better, new, loss)
        damping = np.where(better, np.maximum(0.2 * damping, 1e-12), 5.0 * damping)
        active &= ~ending & (damping <= MAX_DAMPING)
        if not active.any():
            break
    return state


def _loss(state: _PerspectiveState, root: Array, prior: Array) -> Array:
    """Return the loss of each trial, (T,); inf with a point behind a camera."""
    squares = ((root * state.residuals()) ** 2).sum(axis=(1, 2))
    squares = squares + (prior * state.perspective**2).sum(axis=(1, 2))
    in_front = ((state.depths() > 0.0) | (root == 0.0)).all(axis=(1, 2))
    return np.where(in_front & np.isfinite(squares), squares, np.inf)
