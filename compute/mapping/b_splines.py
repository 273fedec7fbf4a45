"""Uniform B-splines of degree 1 and 3: basis in a cell, and interpolation."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.mapping.grid import VoxelGrid, mesh_points

Array = NDArray[np.float64]


def b_spline_basis(cell_coordinate: Array, degree: int) -> tuple[Array, Array]:
    """Return the B-spline basis in a cell and its derivatives.

    C. de Boor, A Practical Guide to Splines, chapter IX; the weights are 0 or more and add up
    to 1.

    Args:
        cell_coordinate: in the cell, from 0 to 1, any shape (...).
        degree: 1 or 3.

    Returns:
        Weights of the degree + 1 coefficients and their derivatives, both of shape (..., degree +
        1).

    Raises:
        InvalidParameter: another degree.
    """
    t = np.asarray(cell_coordinate, dtype=np.float64)
    if degree == 1:
        return np.stack([1.0 - t, t], axis=-1), np.stack([-np.ones_like(t), np.ones_like(t)], -1)
    if degree != 3:
        raise InvalidParameter(f"degree is {degree}; it must be 1 or 3")
    s = 1.0 - t
    weights = [s**3, 4.0 - 6.0 * t**2 + 3.0 * t**3, 4.0 - 6.0 * s**2 + 3.0 * s**3, t**3]
    derivatives = [-3.0 * s**2, 9.0 * t**2 - 12.0 * t, 12.0 * s - 9.0 * s**2, 3.0 * t**2]
    return np.stack(weights, axis=-1) / 6.0, np.stack(derivatives, axis=-1) / 6.0


def interpolate_corners(values: Array) -> Array:
    """Return the cubic spline through values at the cells' corners.

    Along each axis the spline is "not-a-knot": its third derivative is continuous at the first and
    last inner knot (C. de Boor, A Practical Guide to Splines, chapter IV); over one or two cells it
    is the straight line or the parabola.

    Args:
        values: shape (nx + 1, ny + 1, nz + 1).

    Returns:
        Coefficients, shape (nx + 3, ny + 3, nz + 3).
    """
    coefficients = values
    for axis in range(3):
        cells = values.shape[axis] - 1
        matrix = np.zeros((cells + 3, cells + 3))
        for corner in range(cells + 1):
            matrix[corner, corner : corner + 3] = (1.0 / 6.0, 4.0 / 6.0, 1.0 / 6.0)
        ends = np.diff(np.eye(cells + 3), n=min(cells, 3) + 1, axis=0)
        matrix[cells + 1 :] = ends[[0, -1]]
        right = np.zeros((cells + 3, cells + 1))
        right[: cells + 1] = np.eye(cells + 1)
        coefficients = apply_along_axis(np.linalg.solve(matrix, right), coefficients, axis)
    return coefficients


def interpolate_function(grid: VoxelGrid, function: Callable[[Array], Array]) -> Array:
    """Return the cubic spline through a function of space, shape (nx + 3, ny + 3, nz + 3).

    It interpolates at nx + 3 equal steps along each axis.

    Args:
        grid: the voxels.
        function: of points (N, 3) [mm], returns (N,).
    """
    inverses, axes = [], []
    for origin, pitch, cells in zip(grid.origin_mm, grid.pitch_mm, grid.cells, strict=True):
        cell_coordinate = np.linspace(0.0, cells, cells + 3)
        cell = np.minimum(cell_coordinate.astype(np.intp), cells - 1)
        weights, _ = b_spline_basis(cell_coordinate - cell, 3)
        matrix = np.zeros((cells + 3, cells + 3))
        np.put_along_axis(matrix, cell[:, None] + np.arange(4), weights, axis=1)
        inverses.append(np.asarray(np.linalg.inv(matrix), dtype=np.float64))
        axes.append(origin + pitch * cell_coordinate)
    coefficients = function(mesh_points(axes)).reshape([len(axis) for axis in axes])
    for axis, inverse in enumerate(inverses):
        coefficients = apply_along_axis(inverse, coefficients, axis)
    return coefficients


def apply_along_axis(matrix: Array, values: Array, axis: int) -> Array:
    """Return values with a matrix (M, N) applied along one of their axes, of length N.

    Args:
        matrix: shape (M, N).
        values: any shape with N at the axis.
        axis: the axis.
    """
    return np.moveaxis(np.tensordot(matrix, values, axes=(1, axis)), 0, axis)
