"""Support of grid cells by measurements, and variances at the corners of cells."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree

from compute.errors import TooFewPoints
from compute.mapping.coverage import Coverage
from compute.mapping.grid import VoxelGrid, mesh_points

Array = NDArray[np.float64]

REACH = 2.0
"""Radius in which measurements support a cell, in local spacings."""
_MAX_ITERATIONS = 20


def find_supported_cells(
    grid: VoxelGrid, coverage: Coverage, min_neighbours: int
) -> NDArray[np.bool_]:
    """Return the cells that one sensor's measurements support, shape (nx, ny, nz).

    The centre of a supported cell lies in the convex hull of the points that the sensor saw, with
    at least ``min_neighbours`` of them within REACH local spacings, and no part of the cell lies in
    a hole.

    Args:
        grid: the voxels.
        coverage: the points that the sensor saw, their local spacing and their holes.
        min_neighbours: smallest number of points near the cell.
    """
    centres = cell_centres(grid)
    points = coverage.points_mm
    # The distance from the cell's centre to its corners.
    corner = 0.5 * float(np.linalg.norm(grid.pitch_mm))
    found = cKDTree(points).query(centres, k=[1, min_neighbours])
    distance, nearest = np.asarray(found[0]), np.asarray(found[1])
    reach = REACH * coverage.spacing_mm[nearest[:, 0]] + corner
    supported = (
        within_hull(points, centres)
        & (distance[:, 1] <= reach)
        & ~coverage.in_hole(centres, corner)
    )
    return np.asarray(supported.reshape(grid.cells))


def within_hull(points_mm: Array, positions_mm: Array) -> NDArray[np.bool_]:
    """Return which positions lie in the convex hull of points; none in a flat one.

    Args:
        points_mm: shape (N, 3) [mm].
        positions_mm: shape (M, 3) [mm].

    Returns:
        Mask, shape (M,).
    """
    try:
        faces = ConvexHull(points_mm).equations
    except QhullError:
        return np.zeros(len(positions_mm), dtype=np.bool_)
    inside = np.ones(len(positions_mm), dtype=np.bool_)
    for x, y, z, offset in faces:
        inside &= positions_mm @ (x, y, z) + offset <= 0.0
    return inside


def check_supported(valid: NDArray[np.bool_], sensor: str) -> None:
    """Check that a sensor's measurements support any cell.

    Args:
        valid: supported cells, shape (nx, ny, nz).
        sensor: the sensor's name, for the error.

    Raises:
        TooFewPoints: there is no supported cell.
    """
    if not valid.any():
        raise TooFewPoints(
            f"no cell of the grid has enough of sensor {sensor}'s measurements near it; add "
            "points, or take a larger pitch",
            sensor=sensor,
        )


def cell_centres(grid: VoxelGrid) -> Array:
    """Return the cells' centres, shape (nx ny nz, 3) [mm]."""
    return _lattice(grid, [np.arange(cells) + 0.5 for cells in grid.cells])


def cell_corners(grid: VoxelGrid) -> Array:
    """Return the cells' corners, shape ((nx + 1) (ny + 1) (nz + 1), 3) [mm]."""
    return _lattice(grid, [np.arange(cells + 1.0) for cells in grid.cells])


def _lattice(grid: VoxelGrid, node_positions: Sequence[NDArray[np.floating]]) -> Array:
    index = mesh_points(node_positions)
    return np.asarray(np.asarray(grid.origin_mm) + index * np.asarray(grid.pitch_mm))


def corner_values(grid: VoxelGrid, function: Callable[[Array], Array]) -> Array:
    """Return positive values at the corners whose interpolation has the function's means.

    A fit's variance grows ever faster towards the rim: linear interpolation between its values at
    the corners is too large, several times in cells as wide as the points' spacing. A cell's mean
    is a third of its corners' mean and two thirds of its centre, exact for quadratic functions. The
    corner values are scaled iteratively until the cells have these means, as far as possible.

    Args:
        grid: the voxels.
        function: of points (N, 3) [mm], returns positive values (N,).

    Returns:
        Shape (nx + 1, ny + 1, nz + 1).
    """
    values = function(cell_corners(grid)).reshape([cells + 1 for cells in grid.cells])
    centres = function(cell_centres(grid)).reshape(grid.cells)
    wanted = (_neighbour_sums(values) / 8.0 + 2.0 * centres) / 3.0
    around = _neighbour_sums(np.pad(np.ones(grid.cells), 1))
    for _ in range(_MAX_ITERATIONS):
        ratio = wanted / (_neighbour_sums(values) / 8.0)
        values = values * _neighbour_sums(np.pad(ratio, 1)) / around
    return values


def _neighbour_sums(values: Array) -> Array:
    """Return sums of 2 x 2 x 2 neighbouring values (nx + 1, ...), shape (nx, ...)."""
    for axis in range(3):
        low = values.take(range(values.shape[axis] - 1), axis)
        values = low + values.take(range(1, values.shape[axis]), axis)
    return values
