"""Surfaces for registration: point cloud or triangle mesh, with closest points and normals."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from compute.errors import InvalidParameter, TooFewPoints
from compute.transform import finite_points

Array = NDArray[np.float64]

_NEIGHBOURS: Final = 12
_CANDIDATES: Final = 16
_FIRST_CANDIDATES: Final = 3
"""Candidates that are looked at before the others, most of which then cannot be nearer."""
_MAX_SIZE_RATIO: Final = 4.0
"""Largest ratio of the sizes of triangles that are searched together."""
_BATCH_TRIANGLES: Final = 200_000
"""Triangles that are looked at together, unless one point needs more."""


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
            given = _not_empty(normals, "normals")
            length = np.linalg.norm(given, axis=1, keepdims=True)
            if given.shape != self._points.shape or not (length > 0.0).all():
                raise InvalidParameter(
                    f"normals have shape {given.shape}, some perhaps of no length; they must be "
                    f"{self._points.shape}, one for each point"
                )
            self._normals = given / length
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
        found = self._tree.query(points_mm)[1]
        return self._points[found], self._normals[found]


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
        self._corners, centres = corners[real], corners[real].mean(axis=1)
        self._normals = across[real] / size[real, None]
        self._reach = np.linalg.norm(self._corners - centres[:, None], axis=2).max(axis=1)
        size_class = np.floor(np.log(self._reach / self._reach.max()) / np.log(_MAX_SIZE_RATIO))
        self._levels = []
        for one in np.unique(size_class):
            level = np.flatnonzero(size_class == one)
            radius = float(self._reach[level].max())
            self._levels.append(_Level(level, radius, cKDTree(centres[level])))

    def nearest(self, points_mm: Array) -> tuple[Array, Array]:
        """Return the nearest places on the triangles, exactly, and the directions off them."""
        points = np.asarray(points_mm, np.float64)
        near = _Nearest(points, self._corners)
        for level in self._levels:
            level.search(near, self._reach)
        # Next to an edge or a corner the distance increases away from it, not along a normal.
        length = near.distance[:, None]
        tiny = length <= 1e-9 * self._levels[-1].radius
        away = (points - near.place) / np.where(tiny, 1.0, length)
        return near.place, np.where(tiny, self._normals[near.face], away)


@dataclass(frozen=True, eq=False)
class _Level:
    """Triangles of about one size: among those of all sizes the large ones hide the small."""

    faces: NDArray[np.intp]
    radius: float
    tree: cKDTree

    def search(self, near: "_Nearest", reach: Array) -> None:
        """Look at all of them that may be nearer; a triangle is by at most its own reach."""
        few = min(_CANDIDATES, len(self.faces))
        query = self.tree.query(near.points, np.arange(1, few + 1))
        away, found = np.asarray(query[0], np.float64), self.faces[query[1]]
        for start, end in pairwise(sorted({0, 1, min(_FIRST_CANDIDATES, few), few})):
            closest = away[:, start:end] - reach[found[:, start:end]]
            owner, which = np.nonzero(closest < near.distance[:, None])
            near.update(owner, found[owner, start + which])
        rows = np.flatnonzero((few < len(self.faces)) & (away[:, -1] - self.radius < near.distance))
        if not len(rows):
            return
        most = near.distance[rows] + self.radius * (1.0 + 1e-9)
        counts = self.tree.query_ball_point(near.points[rows], most, return_length=True)
        # In batches: for points near the centre of a sphere all triangles are candidates.
        for part in np.split(
            np.arange(len(rows)),
            np.flatnonzero(np.diff(np.cumsum(counts) // _BATCH_TRIANGLES)) + 1,
        ):
            lists = self.tree.query_ball_point(near.points[rows[part]], most[part])
            owner = np.repeat(rows[part], [len(one) for one in lists])
            near.update(owner, self.faces[np.concatenate(lists).astype(np.intp)])


class _Nearest:
    """The nearest places to points so far."""

    def __init__(self, points: Array, corners: Array) -> None:
        self.points = points
        self.place = np.zeros_like(points)
        self.distance = np.full(len(points), np.inf)
        self.face = np.zeros(len(points), np.intp)
        self._corners = corners

    def update(self, owner: NDArray[np.intp], faces: NDArray[np.intp]) -> None:
        """Put in what is nearer, of triangles ``faces`` to the points ``owner``."""
        places = nearest_on_triangles(self.points[owner], self._corners[faces])
        distance = np.linalg.norm(places - self.points[owner], axis=1)
        # The closest triangle of each point comes first.
        order = np.lexsort((distance, owner))
        rows, first = np.unique(owner[order], return_index=True)
        nearer = distance[order[first]] < self.distance[rows]
        rows, chosen = rows[nearer], order[first][nearer]
        self.place[rows], self.face[rows] = places[chosen], faces[chosen]
        self.distance[rows] = distance[chosen]


def nearest_on_triangles(points: Array, corners: Array) -> Array:
    """Return the place on each triangle that is nearest to its point.

    Args:
        points: shape (..., 3).
        corners: shape (..., 3, 3), a row for each corner.
    """
    a, b, c = corners[..., 0, :], corners[..., 1, :], corners[..., 2, :]
    first, second, off = b - a, c - a, points - a
    # Barycentric coordinates of the foot on the plane.
    ff, fs, ss = (_dot(first, first), _dot(first, second), _dot(second, second))
    of, os = _dot(off, first), _dot(off, second)
    area = ff * ss - fs * fs
    u, v = (ss * of - fs * os) / area, (ff * os - fs * of) / area
    outside = ~((u >= 0.0) & (v >= 0.0) & (u + v <= 1.0))
    place: Array = a + u[..., None] * first + v[..., None] * second
    if outside.any():
        points, a, b, c = (np.broadcast_to(one, place.shape)[outside] for one in (points, a, b, c))
        edges = np.stack([_on_edge(points, a, b), _on_edge(points, b, c), _on_edge(points, c, a)])
        nearest = ((edges - points) ** 2).sum(axis=-1).argmin(axis=0)
        place[outside] = edges[nearest, np.arange(len(nearest))]
    return place


def _on_edge(points: Array, start: Array, end: Array) -> Array:
    along = end - start
    share = np.clip(_dot(points - start, along) / _dot(along, along), 0.0, 1.0)
    found: Array = start + share[..., None] * along
    return found


def _dot(one: Array, other: Array) -> Array:
    found: Array = np.einsum("...i,...i->...", one, other)
    return found


def _not_empty(points_mm: Array, name: str) -> Array:
    if not len(points_mm):
        raise InvalidParameter(f"{name} has shape {np.shape(points_mm)}; it must be (N, 3)")
    return finite_points(points_mm, name)
