"""Starting cameras for the geometric refinement: where its minimum is looked for."""

from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.labels.projective import ProjectiveCamera

Array = NDArray[np.float64]

KEPT_STARTS: Final = 6
"""Nodes of the grid from which each sensor is searched, besides its linear solution."""


def starting_cameras(camera: ProjectiveCamera, readings: Array, weights: Array) -> Array:
    """Return projective cameras to start from, shape (S, 1 + KEPT_STARTS, 7).

    With the denominator ``w = 1 + g.X`` fixed, the numerator is linear; all cameras that have
    every point in front of them have g in a bounded set. A grid over that set, with the
    numerator solved for each node (variable projection), shows where the sum of squares is
    small, so that the refinement does not hang on the linear solution alone. The first is that
    linear solution, [5.5].

    Args:
        camera: control points, all seen by all sensors.
        readings: of S sensors, shape (S, N), in the camera's unit.
        weights: 1 / standard deviation of the readings, shape (S, N).
    """
    points = camera.points
    homogeneous = np.column_stack([points, np.ones(len(points))])
    slopes = _grid()
    # Scale each direction so that the nearest point keeps a positive depth.
    reach = (slopes @ points.T).min(axis=1)
    slopes = slopes / np.maximum(-reach, 1.0)[:, None] * 0.999
    inverse = 1.0 / (1.0 + slopes @ points.T)
    products = (homogeneous[:, :, None] * homogeneous[:, None, :]).reshape(len(points), 16)
    squared, right = inverse**2, weights**2 * readings
    starts = []
    for weight, value, reading in zip(weights, right, readings, strict=True):
        normal = (squared @ (products * weight[:, None] ** 2)).reshape(-1, 4, 4)
        # A thousandth of a millionth more of the diagonal: flat frames are refused elsewhere.
        normal[:, range(4), range(4)] *= 1.0 + 1e-9
        moment = inverse @ (homogeneous * value[:, None])
        numerator = np.linalg.solve(normal, moment[..., None])[..., 0]
        cost = value @ reading - (numerator * moment).sum(axis=1)
        best = np.argsort(cost, kind="stable")[:KEPT_STARTS]
        starts.append(np.hstack([numerator[best], slopes[best]]))
    linear = camera.algebraic(readings, weights)
    return np.concatenate([linear[:, None], np.array(starts)], axis=1)


@cache
def _grid() -> Array:
    """Directions on the sphere times slopes, shape (G, 3), in the normalised frame.

    A slope of s means that depth changes by the fraction s over the points' RMS extent.
    """
    count = 48
    turn = np.pi * (1.0 + np.sqrt(5.0)) * (np.arange(count) + 0.5)
    height = 1.0 - 2.0 * (np.arange(count) + 0.5) / count
    ring = np.sqrt(1.0 - height**2)
    directions = np.column_stack([np.cos(turn) * ring, np.sin(turn) * ring, height])
    slopes = np.array([0.02, 0.06, 0.13, 0.27, 0.5])
    grid: Array = (slopes[:, None, None] * directions).reshape(-1, 3)
    return grid
