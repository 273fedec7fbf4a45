"""VoxelGrid: a box of equal cells in object space."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import Vector3, vector3
from compute.errors import InvalidParameter

Array = NDArray[np.float64]


@dataclass(frozen=True)
class VoxelGrid:
    """A box of equal cells along the axes of the world frame.

    Args:
        origin_mm: the corner with the lowest coordinates [mm].
        pitch_mm: edges of a cell [mm], positive.
        cells: how many there are along x, y and z, each 1 or more.

    Raises:
        InvalidParameter: a value that is none of that.
    """

    origin_mm: Vector3
    pitch_mm: Vector3
    cells: tuple[int, int, int]

    def __post_init__(self) -> None:
        if not all(np.isfinite(value) for value in self.origin_mm):
            raise InvalidParameter(f"origin_mm is {self.origin_mm}; it must be finite")
        if not all(0.0 < value < np.inf for value in self.pitch_mm):
            raise InvalidParameter(f"pitch_mm is {self.pitch_mm}; it must be positive")
        if not all(count >= 1 for count in self.cells):
            raise InvalidParameter(f"cells is {self.cells}; there must be at least one each way")

    @property
    def end_mm(self) -> Array:
        """The corner opposite to the origin, shape (3,) [mm]."""
        end: Array = np.asarray(self.origin_mm) + np.asarray(self.pitch_mm) * np.asarray(self.cells)
        return end

    @property
    def corners_mm(self) -> Array:
        """The eight corners of the box, shape (8, 3) [mm]."""
        return mesh_points(tuple(np.stack([np.asarray(self.origin_mm), self.end_mm], axis=1)))

    def extended(self, axis: int, low: int, high: int) -> "VoxelGrid":
        """Return the grid with more cells along an axis.

        Args:
            axis: 0 to 2.
            low: how many before the first.
            high: how many after the last.
        """
        along = np.eye(3, dtype=int)[axis]
        origin = np.asarray(self.origin_mm) - low * along * np.asarray(self.pitch_mm)
        x, y, z = (np.asarray(self.cells) + (low + high) * along).tolist()
        return VoxelGrid(vector3(origin), self.pitch_mm, (x, y, z))

    def contains(self, points_mm: Array) -> NDArray[np.bool_]:
        """Return which points (N, 3) [mm] lie in the box, shape (N,); none that is NaN."""
        steps = (points_mm - np.asarray(self.origin_mm)) / np.asarray(self.pitch_mm)
        inside: NDArray[np.bool_] = ((steps >= 0.0) & (steps <= np.asarray(self.cells))).all(axis=1)
        return inside

    def locate(self, points_mm: Array) -> tuple[NDArray[np.intp], Array, NDArray[np.bool_]]:
        """Locate points in the cells.

        A point beyond the box is projected to its surface.

        Args:
            points_mm: shape (N, 3) [mm], finite.

        Returns:
            Cell indices (N, 3), fractions in [0, 1] (N, 3), and whether inside (N,). A point on a
            face between two cells belongs to the upper one, on the end of the box to the last.
        """
        cell_coordinate = (points_mm - np.asarray(self.origin_mm)) / np.asarray(self.pitch_mm)
        count = np.asarray(self.cells)
        inside = ((cell_coordinate >= 0.0) & (cell_coordinate <= count)).all(axis=1)
        cell_coordinate = np.clip(cell_coordinate, 0.0, count)
        cell = np.minimum(cell_coordinate.astype(np.intp), count - 1)
        return cell, cell_coordinate - cell, inside


def mesh_points(axes: Sequence[NDArray[np.floating]]) -> Array:
    """Return the points of a mesh with these coordinates along x, y and z, shape (N, 3)."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
