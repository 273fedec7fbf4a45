"""Surfaces for registration: point cloud or triangle mesh, with closest points and normals."""

from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from compute.errors import InvalidParameter, TooFewPoints
from compute.transform import finite_points

Array = NDArray[np.float64]

_NEIGHBOURS: Final = 12
_BATCH_POINTS: Final = 64
"""Points that are searched for together: near the centre of a sphere each of its triangles is a
candidate for each of them."""


class Surface(Protocol):
    """A surface with a closest point to any point."""

    exact_normals: bool
    """Whether the normals are given, not estimated from neighbours."""

    def nearest(self, points_mm: Array) -> tuple[Array, Array]:
        """Return the closest surface points (N, 3) [mm] to points (N, 3), and the unit normals."""


class PointCloud:
    """A surface given by points.

    Args:
        points_mm: shape (M, 3) [mm].
        normals: shape (M, 3), of any length but zero; None: estimated as the direction in which
            each point's neighbours spread least.

    Raises:
        TooFewPoints: fewer than twelve points, and no normals.
        InvalidParameter, NonFiniteValue: an array is of a wrong shape, or not finite.
    """

    def __init__(self, points_mm: Array, normals: Array | None = None) -> None:
        self._points = _not_empty(points_mm, "points_mm")
        self._tree = cKDTree(self._points)
        self.exact_normals = normals is not None
        if normals is not None:
            directions = _not_empty(normals, "normals")
            length = np.linalg.norm(directions, axis=1, keepdims=True)
            if directions.shape != self._points.shape or not (length > 0.0).all():
                raise InvalidParameter(
                    f"normals have shape {directions.shape}, some perhaps of no length; they must "
                    f"be {self._points.shape}, one for each point"
                )
            self._normals = directions / length
            return
        if len(self._points) < _NEIGHBOURS:
            raise TooFewPoints(
                f"a cloud of {len(self._points)} points without normals; it needs {_NEIGHBOURS} "
                "or more",
                points=len(self._points),
                needed=_NEIGHBOURS,
            )
        near = self._points[self._tree.query(self._points, _NEIGHBOURS)[1]]
        off = near - near.mean(axis=1, keepdims=True)
        self._normals = np.linalg.eigh(off.swapaxes(1, 2) @ off)[1][..., 0]

    def nearest(self, points_mm: Array) -> tuple[Array, Array]:
        """Return the nearest points of the cloud, and their normals."""
        nearest = self._tree.query(points_mm)[1]
        return self._points[nearest], self._normals[nearest]


class TriangleMesh:
    """A surface of triangles.

    Args:
        vertices_mm: shape (V, 3) [mm].
        faces: indices of vertices, shape (F, 3); triangles of no area are left out.

    Raises:
        TooFewPoints: no triangle has an area.
        InvalidParameter, NonFiniteValue: an array is not what it should be.
    """

    exact_normals = True

    def __init__(self, vertices_mm: Array, faces: NDArray[np.intp]) -> None:
        self.vertices_mm = _not_empty(vertices_mm, "vertices_mm")
        self.faces = faces = np.asarray(faces)
        if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
            raise InvalidParameter(
                f"faces have shape {faces.shape} and type {faces.dtype}; they must be whole "
                "numbers, (F, 3)"
            )
        if faces.size and (faces.min() < 0 or faces.max() >= len(self.vertices_mm)):
            raise InvalidParameter(
                f"faces name vertices {faces.min()} to {faces.max()}; there are "
                f"{len(self.vertices_mm)}"
            )
        corners = self.vertices_mm[faces]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        size = np.linalg.norm(across, axis=1)
        real = size > 1e-12 * max(float(size.max(initial=0.0)), 1e-300)
        if not real.any():
            raise TooFewPoints(f"none of {len(faces)} triangles has an area", triangles=len(faces))
        self._normals = across[real] / size[real, None]
        self._tiny_mm = 1e-9 * float(np.sqrt(size.max()))
        # Here and not above: it is loaded by who has a mesh.
        from trimesh import Trimesh

        self._mesh = Trimesh(self.vertices_mm, faces[real], process=False)

    def nearest(self, points_mm: Array) -> tuple[Array, Array]:
        """Return the nearest points of the triangles, exactly, and the directions off them."""
        from trimesh.proximity import closest_point

        points = np.asarray(points_mm, np.float64)
        parts = [
            closest_point(self._mesh, points[first : first + _BATCH_POINTS])
            for first in range(0, len(points), _BATCH_POINTS)
        ]
        closest, distance, face = (np.concatenate(column) for column in zip(*parts, strict=True))
        # Next to an edge or a corner the distance increases away from it, not along a normal.
        tiny = (distance <= self._tiny_mm)[:, None]
        away = (points - closest) / np.where(tiny, 1.0, distance[:, None])
        return closest, np.where(tiny, self._normals[face], away)


def _not_empty(points_mm: Array, name: str) -> Array:
    if not len(points_mm):
        raise InvalidParameter(f"{name} has shape {np.shape(points_mm)}; it must be (N, 3)")
    return finite_points(points_mm, name)
