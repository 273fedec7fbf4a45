"""Starting cameras for the geometric refinement: where its minimum is looked for."""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from compute.calibration.linear import linear_matrix, normalisation

Array = NDArray[np.float64]

KEPT_STARTS = 4


def starting_matrices(points_mm: Array, readings_px: Array, weights: Array, sensor: str) -> Array:
    """Return 2x4 matrices to start from, shape (K, 2, 4), with all points in front.

    With the denominator ``w = 1 + g.(X - centroid)`` fixed, the numerator is linear; all cameras
    that have every point in front of them have g in a bounded set. A grid over that set, with
    the numerator solved for each node (variable projection), shows where the sum of squares is
    small, so that the refinement does not hang on the linear solution alone.

    Args:
        points_mm: control points, shape (N, 3).
        readings_px: readings, shape (N,) [px].
        weights: 1 / standard deviation of the readings, shape (N,) [1/px].
        sensor: the sensor's name, for an error.
    """
    linear = linear_matrix(points_mm, readings_px, sensor)
    transform = normalisation(points_mm)
    homogeneous = np.column_stack([points_mm, np.ones(len(points_mm))]) @ transform.T
    slopes = _grid()
    # Scale each direction so that the nearest point keeps a positive depth.
    reach = (slopes @ homogeneous[:, :3].T).min(axis=1)
    slopes = slopes / np.maximum(-reach, 1.0)[:, None] * 0.999
    depth = 1.0 + slopes @ homogeneous[:, :3].T
    design = homogeneous / depth[..., None] * weights[:, None]
    orthonormal, _ = np.linalg.qr(design)
    right = readings_px * weights
    projected = np.einsum("gni,n->gi", orthonormal, right)
    cost = right @ right - (projected**2).sum(axis=1)
    best = np.argsort(cost, kind="stable")[:KEPT_STARTS]
    starts = []
    for node in best:
        numerator = np.linalg.lstsq(design[node], right, rcond=None)[0]
        starts.append(np.array([numerator, [*slopes[node], 1.0]]) @ transform)
    side = linear[1, :3] @ points_mm.T + linear[1, 3]
    if (side > 0).all() or (side < 0).all():
        starts.insert(0, linear if side[0] > 0 else -linear)
    return np.array(starts)


@cache
def _grid() -> Array:
    """Directions on the sphere times slopes, shape (G, 3), in the normalised frame.

    A slope of s means that depth changes by the fraction s over the points' RMS extent.
    """
    count = 96
    turn = np.pi * (1.0 + np.sqrt(5.0)) * (np.arange(count) + 0.5)
    height = 1.0 - 2.0 * (np.arange(count) + 0.5) / count
    ring = np.sqrt(1.0 - height**2)
    directions = np.column_stack([np.cos(turn) * ring, np.sin(turn) * ring, height])
    slopes = np.array([0.02, 0.05, 0.1, 0.2, 0.35, 0.5])
    grid: Array = (slopes[:, None, None] * directions).reshape(-1, 3)
    return grid
