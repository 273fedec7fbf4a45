"""SampleGrid: measurements on a regular grid, and interpolation through them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from compute.errors import InvalidParameter
from compute.mapping.b_splines import interpolate_corners
from compute.mapping.grid import VoxelGrid

Array = NDArray[np.float64]

NODE_TOLERANCE = 1e-3
"""Tolerance of equal coordinates and of equal steps, relative to the pitch."""
_SPLINE_REACH = 2  # nodes over which a missing value affects a cubic spline by up to a twentieth


@dataclass(frozen=True, eq=False)
class SampleGrid:
    """Positions of measurements on a regular grid.

    Args:
        grid: the corners of its cells are the nodes.
        node_index: node of each measurement, shape (N, 3).
    """

    grid: VoxelGrid
    node_index: NDArray[np.intp]

    @classmethod
    def of(cls, points_mm: Array) -> "SampleGrid":
        """Find the regular grid of points (N, 3) [mm]; nodes may be missing.

        Raises:
            InvalidParameter: the points lie on no regular grid.
        """
        axes = [_steps(points_mm[:, axis], "XYZ"[axis]) for axis in range(3)]
        (x, dx, nx), (y, dy, ny), (z, dz, nz) = axes
        grid = VoxelGrid((x, y, z), (dx, dy, dz), (nx, ny, nz))
        cell_coordinate = (points_mm - np.asarray(grid.origin_mm)) / np.asarray(grid.pitch_mm)
        return cls(grid, np.rint(cell_coordinate).astype(np.intp))

    def interpolate(self, values: Array, degree: int) -> tuple[Array, NDArray[np.bool_]]:
        """Return the spline through values, and the cells that they support.

        A cell is supported if all its nodes have values: its corners and, for degree 3, those
        around it.

        Args:
            values: shape (N,); NaN where unknown.
            degree: 1 or 3.
        """
        missing = np.isnan(self._to_grid(values))
        filled = self.fill_nearest(values)
        reach = 0 if degree == 1 else _SPLINE_REACH - 1
        valid = np.ones(self.grid.cells, dtype=np.bool_)
        for x, y, z in np.argwhere(missing):
            valid[
                max(x - 1 - reach, 0) : x + 1 + reach,
                max(y - 1 - reach, 0) : y + 1 + reach,
                max(z - 1 - reach, 0) : z + 1 + reach,
            ] = False
        return (filled if degree == 1 else interpolate_corners(filled)), valid

    def fill_nearest(self, values: Array) -> Array:
        """Return values (N,) at the nodes, shape (nx + 1, ...); missing ones of the nearest."""
        nodes = self._to_grid(values)
        index = distance_transform_edt(np.isnan(nodes), return_distances=False, return_indices=True)
        return np.asarray(nodes[tuple(index)])

    def _to_grid(self, values: Array) -> Array:
        nodes = np.full([cells + 1 for cells in self.grid.cells], np.nan)
        nodes[tuple(self.node_index.T)] = values
        return nodes


def _steps(values: Array, axis: str) -> tuple[float, float, int]:
    """Return the first coordinate, the step and the number of cells along an axis.

    Raises:
        InvalidParameter: the coordinates are all the same, or not equally spaced.
    """
    found = np.unique(values)
    extent = float(found[-1] - found[0])
    # Coordinates that differ by rounding are one.
    apart = np.flatnonzero(np.diff(found) > NODE_TOLERANCE * extent)
    groups = np.split(found, apart + 1)
    coordinates = np.array([group.mean() for group in groups])
    cells = len(coordinates) - 1
    pitch = extent / max(cells, 1)
    even = coordinates[0] + pitch * np.arange(cells + 1)
    if cells < 1 or np.abs(found - even[np.digitize(found, coordinates[1:] - pitch / 2)]).max() > (
        NODE_TOLERANCE * pitch
    ):
        raise InvalidParameter(
            f"the points have {len(coordinates)} different {axis} from {found[0]:g} to "
            f"{found[-1]:g} mm that are not equally spaced; interpolation through the values "
            'needs points on a grid of equal steps, points anywhere take the method "b-spline"',
            axis=axis,
        )
    return float(coordinates[0]), pitch, cells
