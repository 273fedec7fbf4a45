"""Values at cells' corners whose linear interpolation has a curved function's means."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from compute.mapping.cell_support import cell_centres, cell_corners
from compute.mapping.grid import VoxelGrid

Array = NDArray[np.float64]

_MAX_ITERATIONS = 20


def corner_values(grid: VoxelGrid, function: Callable[[Array], Array]) -> Array:
    """Return positive values at the corners, with the function's mean in every cell if that can be.

    The variance of a fit grows towards the rim faster and faster: interpolated between its values
    at the corners it is too large everywhere between, several times in cells as wide as the
    points are apart. A cell's mean is that of its corners' by a third, and its middle's by two
    thirds, exactly so for quadratic functions. The corners are moved there by factors, those of
    the cells around, in turn.

    Args:
        grid: the voxels.
        function: of points (N, 3) [mm], returns (N,), positive.

    Returns:
        Shape (nx + 1, ny + 1, nz + 1).
    """
    values = function(cell_corners(grid)).reshape([cells + 1 for cells in grid.cells])
    middles = function(cell_centres(grid)).reshape(grid.cells)
    wanted = (_mean_of_corners(values) + 2.0 * middles) / 3.0
    around = _sum_around(np.ones(grid.cells))
    for _ in range(_MAX_ITERATIONS):
        values = values * _sum_around(wanted / _mean_of_corners(values)) / around
    return values


def _mean_of_corners(values: Array) -> Array:
    """Return the means of the corners' values (nx + 1, ...) by cell, shape (nx, ...)."""
    for axis in range(3):
        low = values.take(range(values.shape[axis] - 1), axis)
        values = 0.5 * (low + values.take(range(1, values.shape[axis]), axis))
    return values


def _sum_around(values: Array) -> Array:
    """Return the sums of the values (nx, ...) of the cells around corners, (nx + 1, ...)."""
    padded = np.pad(values, 1)
    for axis in range(3):
        low = padded.take(range(padded.shape[axis] - 1), axis)
        padded = low + padded.take(range(1, padded.shape[axis]), axis)
    return padded
