"""Least trimmed squares: cameras fitted to the majority of a sensor's readings."""

import numpy as np
from numpy.typing import NDArray

from compute.calibration.single_sensor.camera_fit import minimise
from compute.calibration.single_sensor.lens_prior import LensPrior
from compute.calibration.single_sensor.projective_camera import ProjectiveCamera
from compute.camera.model import PARAMETER_COUNT
from compute.camera.stack import CameraStack

Array = NDArray[np.float64]

RANDOM_SUBSETS = 300
"""With six wrong readings in 19, one of 30 subsets of seven is clean: the probability that none of
300 is, is 3e-5; with four wrong ones 2e-18."""
REFINED_SUBSETS = 10
DISTORTED_SUBSETS = 150
"""Of subsets of eight of 15 readings with two wrong ones a fifth is clean, of 19 with four a
twelfth: the probability that none of 150 is, is 3e-6."""
SEED = 1981  # Any: the draw decides where the search starts, not what it finds.


def robust_starts(
    camera: ProjectiveCamera, readings_px: Array, sigma_px: Array, count: int
) -> Array:
    """Return cameras of least trimmed squares, best first, shape (at most ``count``, 7).

    Random subsets of seven readings start the search; each camera is concentrated on the readings
    that it fits best (Rousseeuw and Van Driessen, "Computing LTS Regression for Large Data Sets",
    doi:10.1007/s10618-005-0024-4), at least (n + 8) / 2 of n.

    Args:
        camera: the control points.
        readings_px: readings, shape (N,) [px]; NaN where not seen.
        sigma_px: their standard deviations, shape (N,) [px].
        count: largest number of cameras returned.
    """
    measured = np.flatnonzero(np.isfinite(readings_px))
    rng = np.random.default_rng(SEED)
    chosen = measured[
        np.argsort(rng.random((RANDOM_SUBSETS, len(measured))), axis=1)[:, :PARAMETER_COUNT]
    ]
    values = np.where(np.isfinite(readings_px), readings_px, camera.centre_px)
    unit = np.zeros(len(values))
    unit[measured] = 1.0 / sigma_px[measured]
    weights = np.zeros((RANDOM_SUBSETS, len(values)))
    np.put_along_axis(weights, chosen, unit[chosen], axis=1)
    covered = min(len(measured), (len(measured) + camera.width + 1) // 2)
    theta = camera.algebraic(np.broadcast_to(values, weights.shape), weights)
    theta, cost = _concentrate(camera, values, unit, theta, covered, rounds=2, steps=2)
    theta = theta[np.argsort(cost, kind="stable")[:REFINED_SUBSETS]]
    theta, cost = _concentrate(camera, values, unit, theta, covered, rounds=8, steps=6)
    order = np.argsort(cost, kind="stable")
    distinct: list[int] = []
    for index in order:
        near = [abs(cost[index] - cost[other]) <= 1e-6 * cost[other] for other in distinct]
        if not any(near):
            distinct.append(int(index))
    return np.asarray(theta[distinct[:count]])


def _concentrate(
    camera: ProjectiveCamera,
    values: Array,
    unit: Array,
    theta: Array,
    covered: int,
    rounds: int,
    steps: int,
) -> tuple[Array, Array]:
    """Alternate between selecting the best-fitted readings and fitting; cameras and costs."""
    rows = np.broadcast_to(values, (len(theta), len(values)))
    cost = np.zeros(len(theta))
    for iteration in range(rounds + 1):
        squares = ((camera.project(theta) - values) * unit) ** 2
        squares[:, unit == 0.0] = np.inf
        nearest = np.argpartition(squares, covered - 1, axis=1)[:, :covered]
        cost = np.take_along_axis(squares, nearest, axis=1).sum(axis=1)
        if iteration == rounds:
            break
        weights = np.zeros(rows.shape)
        np.put_along_axis(weights, nearest, unit[nearest], axis=1)
        theta = camera.fit(rows, weights, theta, steps)
    return theta, cost


def covered_readings(seen: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return how many readings of each sensor a trimmed fit covers, (n + 8) / 2 of n, shape (S,).

    Args:
        seen: which readings there are, shape (N, S).
    """
    count = seen.sum(axis=0)
    return np.asarray(np.minimum(count, (count + PARAMETER_COUNT + 2) // 2))


def trimmed_distorted_cameras(
    cameras: CameraStack,
    points_mm: Array,
    readings_px: Array,
    weights: Array,
    prior: LensPrior,
) -> tuple[CameraStack, Array]:
    """Return each sensor's camera with distortion of least trimmed squares.

    Random subsets of eight readings start the search, as in ``robust_starts``; all subsets of all
    sensors are fitted at once.

    Args:
        cameras: S cameras to start from, with their terms.
        points_mm: control points, shape (N, 3) [mm].
        readings_px: shape (N, S) [px]; NaN where not seen.
        weights: 1 / standard deviation, shape (N, S) [1/px]; 0: not seen.
        prior: of the lenses, in units of the weights.

    Returns:
        The S cameras, and 1 for the readings that they cover or that were not seen, 0 for the
        others, shape (N, S).
    """
    sensors = len(cameras)
    seen = weights > 0.0
    rng = np.random.default_rng(SEED)
    # (T, N, S): the readings of a sensor in random order, those not seen last.
    order = np.argsort(rng.random((DISTORTED_SUBSETS, *weights.shape)) + ~seen, axis=1)
    rank = np.argsort(order, axis=1)
    chosen = (rank <= PARAMETER_COUNT).transpose(1, 0, 2).reshape(len(weights), -1) & np.tile(
        seen, DISTORTED_SUBSETS
    )
    sensor = np.tile(np.arange(sensors), DISTORTED_SUBSETS)
    covered = covered_readings(seen)
    state = _concentrate_distorted(
        cameras.rows(sensor), (points_mm, readings_px, weights), prior, covered, sensor,
        chosen, rounds=2, steps=5,
    )  # fmt: skip
    kept = np.argsort(state[2].reshape(-1, sensors), axis=0, kind="stable")[:REFINED_SUBSETS]
    index = (kept * sensors + np.arange(sensors)).ravel()
    sensor = sensor[index]
    state = _concentrate_distorted(
        state[0].rows(index), (points_mm, readings_px, weights), prior, covered, sensor,
        state[1][:, index], rounds=8, steps=6,
    )  # fmt: skip
    best = np.argmin(state[2].reshape(-1, sensors), axis=0) * sensors + np.arange(sensors)
    return state[0].rows(best), np.where(seen, state[1][:, best], 1.0)


def _concentrate_distorted(
    cameras: CameraStack,
    observed: tuple[Array, Array, Array],
    prior: LensPrior,
    covered: NDArray[np.intp],
    sensor: NDArray[np.intp],
    chosen: NDArray[np.bool_],
    rounds: int,
    steps: int,
) -> tuple[CameraStack, NDArray[np.bool_], Array]:
    """Alternate between fitting the chosen readings and choosing those that are fitted best.

    Args:
        cameras: B cameras.
        observed: points, readings and weights of all sensors.
        prior: of the lenses of all sensors.
        covered: number of readings to choose, shape (S,).
        sensor: of each camera, shape (B,).
        chosen: readings to begin with, shape (N, B).
        rounds: number of choices.
        steps: of each fit.

    Returns:
        The cameras, the readings that they fit best (N, B), and the sums of their squares (B,).
    """
    points, readings, weights = observed[0], observed[1][:, sensor], observed[2][:, sensor]
    for _ in range(rounds):
        cameras = minimise(
            cameras, points, readings, np.where(chosen, weights, 0.0), prior.rows(sensor), steps
        ).cameras
        residuals = cameras.project(points) - readings
        # Not seen, or behind the lens.
        squares = np.where(np.isfinite(residuals), (residuals * weights) ** 2, np.inf)
        squares[weights == 0.0] = np.inf
        rank = np.argsort(np.argsort(squares, axis=0, kind="stable"), axis=0)
        chosen = (rank < covered[sensor]) & (weights > 0.0)
        cost = np.where(chosen, squares, 0.0).sum(axis=0)
    return cameras, chosen, cost
