"""Which cells of a grid measurements support."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes
from scipy.spatial import ConvexHull, QhullError, cKDTree

from compute.errors import TooFewPoints
from compute.mapping.grid import VoxelGrid

Array = NDArray[np.float64]

REACH = 2.0
"""How near measurements must be, in distances between neighbours."""


def find_supported_cells(
    grid: VoxelGrid, seen_mm: Array, min_neighbours: int, spacing_mm: float
) -> NDArray[np.bool_]:
    """Return the cells that one sensor's measurements support, shape (nx, ny, nz).

    A cell's middle must lie in the convex hull of the points that the sensor saw, and at least
    ``min_neighbours`` of them within REACH distances between neighbours, counted from the cell: holes
    inside the hull are not vouched for.

    Args:
        grid: the voxels.
        seen_mm: the points that the sensor saw, shape (N, 3) [mm].
        min_neighbours: as said.
        spacing_mm: distance between neighbouring points [mm].
    """
    middles = cell_centres(grid)
    near = within_hull(seen_mm, middles)
    # From the cell's middle to its corners comes on top, so that a wide cell has its neighbours.
    reach = REACH * spacing_mm + 0.5 * float(np.linalg.norm(grid.pitch_mm))
    counts = cKDTree(seen_mm).query_ball_point(middles, reach, return_length=True)
    found: NDArray[np.bool_] = (near & (counts >= min_neighbours)).reshape(grid.cells)
    return found


def within_hull(points_mm: Array, positions_mm: Array) -> NDArray[np.bool_]:
    """Return which places (M, 3) lie in the convex hull of points (N, 3); none in a flat one."""
    try:
        faces = ConvexHull(points_mm).equations
    except QhullError:
        return np.zeros(len(positions_mm), dtype=np.bool_)
    inside = np.ones(len(positions_mm), dtype=np.bool_)
    for x, y, z, offset in faces:
        inside &= positions_mm @ (x, y, z) + offset <= 0.0
    return inside


def check_no_holes(valid: NDArray[np.bool_], grid: VoxelGrid, sensor: str) -> None:
    """Check that the cells (nx, ny, nz) that are vouched for enclose none that is not.

    Raises:
        TooFewPoints: they do, or there are none.
    """
    if not valid.any():
        raise TooFewPoints(
            f"no cell of the grid has enough of sensor {sensor}'s measurements near it; add "
            "points, or take a larger pitch",
            sensor=sensor,
        )
    holes = np.argwhere(binary_fill_holes(valid) & ~valid)
    if len(holes):
        place = np.asarray(grid.origin_mm) + (holes[0] + 0.5) * np.asarray(grid.pitch_mm)
        raise TooFewPoints(
            f"sensor {sensor}'s measurements leave a hole of {len(holes)} cells, the first around "
            f"{np.round(place, 1).tolist()} mm; add points there, or take a larger pitch",
            sensor=sensor,
            cells=len(holes),
        )


def cell_centres(grid: VoxelGrid) -> Array:
    """Return the cells' middles, shape (nx ny nz, 3) [mm]."""
    return _lattice(grid, [np.arange(cells) + 0.5 for cells in grid.cells])


def cell_corners(grid: VoxelGrid) -> Array:
    """Return the cells' corners, shape ((nx + 1) (ny + 1) (nz + 1), 3) [mm]."""
    return _lattice(grid, [np.arange(cells + 1.0) for cells in grid.cells])


def _lattice(grid: VoxelGrid, node_positions: Sequence[NDArray[np.floating]]) -> Array:
    index = np.stack([one.ravel() for one in np.meshgrid(*node_positions, indexing="ij")], axis=1)
    lattice: Array = np.asarray(grid.origin_mm) + index * np.asarray(grid.pitch_mm)
    return lattice
