"""Measurements on a grid, and the corrections that go through them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from compute.errors import InvalidParameter
from compute.mapping.grid import VoxelGrid
from compute.mapping.spline_interpolation import interpolate_corners

Array = NDArray[np.float64]

NODE_TOLERANCE = 1e-3
"""Of the pitch: coordinates so near are the same, and steps so alike are equal."""
_SPLINE_REACH = 2  # nodes over which a missing value shows in a cubic spline, by a twentieth


@dataclass(frozen=True, eq=False)
class SampleGrid:
    """Where measurements lie on a grid.

    Args:
        grid: its cells' corners are the nodes.
        node_index: of each measurement, shape (N, 3).
    """

    grid: VoxelGrid
    node_index: NDArray[np.intp]

    @classmethod
    def of(cls, points_mm: Array) -> "SampleGrid":
        """Find the grid of points (N, 3) [mm]; nodes may be missing.

        Raises:
            InvalidParameter: they are on none.
        """
        axes = [_steps(points_mm[:, axis], "XYZ"[axis]) for axis in range(3)]
        (x, dx, nx), (y, dy, ny), (z, dz, nz) = axes
        grid = VoxelGrid((x, y, z), (dx, dy, dz), (nx, ny, nz))
        cell_coordinate = (points_mm - np.asarray(grid.origin_mm)) / np.asarray(grid.pitch_mm)
        return cls(grid, np.rint(cell_coordinate).astype(np.intp))

    def interpolate(self, values: Array, degree: int) -> tuple[Array, NDArray[np.bool_]]:
        """Return the coefficients of a spline through values, and which cells they support.

        A cell is supported where all nodes are there that it depends on: its corners, for degree
        3 those around it, too.

        Args:
            values: shape (N,); NaN where nothing is known.
            degree: 1 or 3.
        """
        nodes = self.to_grid(values)
        missing = np.isnan(nodes)
        filled = _filled(nodes)
        reach = 0 if degree == 1 else _SPLINE_REACH - 1
        valid = np.ones(self.grid.cells, dtype=np.bool_)
        for x, y, z in np.argwhere(missing):
            valid[
                max(x - 1 - reach, 0) : x + 1 + reach,
                max(y - 1 - reach, 0) : y + 1 + reach,
                max(z - 1 - reach, 0) : z + 1 + reach,
            ] = False
        return (filled if degree == 1 else interpolate_corners(filled)), valid

    def to_grid(self, values: Array) -> Array:
        """Return values (N,) at the nodes, shape (nx + 1, ny + 1, nz + 1); NaN where none is."""
        nodes = np.full([cells + 1 for cells in self.grid.cells], np.nan)
        nodes[tuple(self.node_index.T)] = values
        return nodes


def fill_nearest(sample_grid: SampleGrid, values: Array) -> Array:
    """Return values (N,) at all nodes; where none is known, that of the nearest."""
    return _filled(sample_grid.to_grid(values))


def _filled(nodes: Array) -> Array:
    missing = np.isnan(nodes)
    if not missing.any():
        return nodes
    index = distance_transform_edt(missing, return_distances=False, return_indices=True)
    filled: Array = nodes[tuple(index)]
    return filled


def _steps(values: Array, axis: str) -> tuple[float, float, int]:
    """Return the first coordinate, the step and the number of cells along an axis."""
    found = np.unique(values)
    extent = float(found[-1] - found[0])
    # Coordinates that differ by rounding are one.
    apart = np.flatnonzero(np.diff(found) > NODE_TOLERANCE * extent)
    groups = np.split(found, apart + 1)
    middles = np.array([group.mean() for group in groups])
    cells = len(middles) - 1
    pitch = extent / max(cells, 1)
    even = middles[0] + pitch * np.arange(cells + 1)
    if cells < 1 or np.abs(found - even[np.digitize(found, middles[1:] - pitch / 2)]).max() > (
        NODE_TOLERANCE * pitch
    ):
        raise InvalidParameter(
            f"the points have {len(middles)} different {axis} from {found[0]:g} to "
            f"{found[-1]:g} mm that are not equally spaced; interpolation through the values "
            'needs points on a grid of equal steps, points anywhere take the method "b-spline"',
            axis=axis,
        )
    return float(middles[0]), pitch, cells
