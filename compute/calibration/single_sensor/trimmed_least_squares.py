"""Least trimmed squares: cameras fitted to the majority of a sensor's readings."""

import numpy as np
from numpy.typing import NDArray

from compute.calibration.single_sensor.projective_camera import ProjectiveCamera
from compute.camera.model import PARAMETER_COUNT

Array = NDArray[np.float64]

RANDOM_SUBSETS = 300
"""With six wrong readings in 19, one of 30 subsets of seven is clean: the probability that none of
300 is, is 3e-5; with four wrong ones 2e-18."""
REFINED_SUBSETS = 10
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
