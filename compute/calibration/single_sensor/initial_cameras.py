"""Starting cameras for the geometric refinement: where its minimum is looked for."""

from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.single_sensor.projective_camera import ProjectiveCamera

Array = NDArray[np.float64]

LOWEST_STARTS: Final = 6
"""Nodes of the grid from which each sensor is searched, besides its linear solution."""
DUPLICATE_TOLERANCE: Final = 1e-12
"""Relative weights of sensors that differ by less are the same: one matrix serves all."""


def starting_cameras(camera: ProjectiveCamera, readings: Array, weights: Array) -> Array:
    """Return projective cameras to start from, shape (S, 1 + LOWEST_STARTS, 7).

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
    gradients = _grid()
    # Scale each direction so that the nearest point keeps a positive depth.
    reach = (gradients @ points.T).min(axis=1)
    gradients = gradients / np.maximum(-reach, 1.0)[:, None] * 0.999
    inverse = 1.0 / (1.0 + gradients @ points.T)
    relative = weights / weights.max(axis=1, keepdims=True)
    if np.ptp(relative, axis=0).max() <= DUPLICATE_TOLERANCE:
        numerators, costs = _numerators(points, inverse, relative[0], readings)
    else:
        each = [
            _numerators(points, inverse, weight, reading[None])
            for weight, reading in zip(relative, readings, strict=True)
        ]
        numerators, costs = (np.concatenate(parts) for parts in zip(*each, strict=True))
    best = np.argpartition(costs, LOWEST_STARTS, axis=1)[:, :LOWEST_STARTS]
    chosen = numerators[np.arange(len(readings))[:, None], best]
    nodes = np.concatenate([chosen, gradients[best]], axis=2)
    return np.concatenate([camera.algebraic(readings, weights)[:, None], nodes], axis=1)


def _numerators(
    points: Array, inverse: Array, weight: Array, readings: Array
) -> tuple[Array, Array]:
    """Return the best numerators (S, G, 4) of S sensors, and their sums of squares (S, G).

    Args:
        points: shape (N, 3).
        inverse: 1 / denominator at the points, of each of G nodes, shape (G, N).
        weight: of the readings of all these sensors, shape (N,).
        readings: shape (S, N).
    """
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    weighted = homogeneous * weight[:, None] ** 2
    products = (homogeneous[:, :, None] * weighted[:, None, :]).reshape(len(points), 16)
    normal = (inverse**2 @ products).reshape(-1, 4, 4)
    # A thousandth of a millionth more of the diagonal: flat frames are refused elsewhere.
    normal *= 1.0 + 1e-9 * np.eye(4)
    right = (weighted[:, :, None] * readings.T[:, None, :]).reshape(len(points), -1)
    moment = (inverse @ right).reshape(len(inverse), 4, -1)
    numerator = np.asarray(np.linalg.solve(normal, moment), dtype=np.float64)
    squares = (readings**2) @ weight**2
    cost: Array = squares[:, None] - (numerator * moment).sum(axis=1).T
    return numerator.transpose(2, 0, 1), cost


@cache
def _grid() -> Array:
    """Directions on the sphere times slopes, shape (G, 3), in the normalised frame.

    A slope of s means that depth changes by the fraction s over the points' RMS extent.
    """
    count = 48
    angle = np.pi * (1.0 + np.sqrt(5.0)) * (np.arange(count) + 0.5)
    height = 1.0 - 2.0 * (np.arange(count) + 0.5) / count
    ring = np.sqrt(1.0 - height**2)
    directions = np.column_stack([np.cos(angle) * ring, np.sin(angle) * ring, height])
    gradients = np.array([0.02, 0.06, 0.13, 0.27, 0.5])
    grid: Array = (gradients[:, None, None] * directions).reshape(-1, 3)
    return grid
