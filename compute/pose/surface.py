"""Surfaces to register with: a cloud of points or a triangle mesh, and nearest places on it."""

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from compute.errors import InvalidParameter, NonFiniteValue, TooFewPoints

Array = NDArray[np.float64]

_NEIGHBOURS: Final = 12
_CANDIDATES: Final = 16
_FIRST: Final = 3
"""Candidates that are looked at before the others, most of which then cannot be nearer."""


class Surface(Protocol):
    """Something with a nearest place to any point."""

    @property
    def exact_normals(self) -> bool:
        """Whether normals are given, and not estimated from neighbours."""

    def nearest(self, points_mm: Array) -> tuple[Array, Array]:
        """Return the nearest places (N, 3) [mm] to points (N, 3), and the unit normals there."""


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points of a surface.

    Args:
        points_mm: shape (M, 3) [mm].
        normals: shape (M, 3), of any length but zero; None: not known, and estimated as the
            direction in which each point's neighbours spread least.

    Raises:
        TooFewPoints: fewer than twelve points, and no normals.
        InvalidParameter, NonFiniteValue: an array is not what it should be.
    """

    points_mm: Array
    normals: Array | None = None
    _tree: cKDTree = field(init=False, repr=False)
    _units: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        points = _checked(self.points_mm, "points_mm")
        tree = cKDTree(points)
        object.__setattr__(self, "points_mm", points)
        object.__setattr__(self, "_tree", tree)
        if self.normals is not None:
            normals = _checked(self.normals, "normals")
            length = np.linalg.norm(normals, axis=1, keepdims=True)
            if normals.shape != points.shape or not (length > 0.0).all():
                raise InvalidParameter(
                    f"normals have shape {normals.shape}, some perhaps of no length; they must be "
                    f"{points.shape}, one for each point"
                )
            object.__setattr__(self, "_units", normals / length)
            return
        if len(points) < _NEIGHBOURS:
            raise TooFewPoints(
                f"a cloud of {len(points)} points without normals; it needs {_NEIGHBOURS} or more",
                points=len(points),
                needed=_NEIGHBOURS,
            )
        near = points[tree.query(points, _NEIGHBOURS)[1]]
        off = near - near.mean(axis=1, keepdims=True)
        axes = np.linalg.eigh(off.swapaxes(1, 2) @ off)[1]
        object.__setattr__(self, "_units", axes[..., 0])

    @property
    def exact_normals(self) -> bool:
        """Whether normals were given."""
        return self.normals is not None

    def nearest(self, points_mm: Array) -> tuple[Array, Array]:
        """Return the nearest points of the cloud, and their normals."""
        found = self._tree.query(points_mm)[1]
        return self.points_mm[found], self._units[found]


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A surface of triangles.

    Args:
        vertices_mm: shape (V, 3) [mm].
        faces: indices of vertices, shape (F, 3); triangles of no area are left out.

    Raises:
        TooFewPoints: no triangle has an area.
        InvalidParameter, NonFiniteValue: an array is not what it should be.
    """

    vertices_mm: Array
    faces: NDArray[np.intp]
    _corners: Array = field(init=False, repr=False)
    _units: Array = field(init=False, repr=False)
    _reach: Array = field(init=False, repr=False)
    _radius: float = field(init=False, repr=False)
    _tree: cKDTree = field(init=False, repr=False)

    def __post_init__(self) -> None:
        vertices = _checked(self.vertices_mm, "vertices_mm")
        faces = np.asarray(self.faces)
        if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
            raise InvalidParameter(
                f"faces have shape {faces.shape} and type {faces.dtype}; they must be whole "
                "numbers, (F, 3)"
            )
        if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
            raise InvalidParameter(
                f"faces name vertices {faces.min()} to {faces.max()}; there are {len(vertices)}"
            )
        corners = vertices[faces]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        size = np.linalg.norm(across, axis=1)
        real = size > 1e-12 * max(float(size.max(initial=0.0)), 1e-300)
        if not real.any():
            raise TooFewPoints(f"none of {len(faces)} triangles has an area", triangles=len(faces))
        corners, middles = corners[real], corners[real].mean(axis=1)
        object.__setattr__(self, "_corners", corners)
        object.__setattr__(self, "_units", across[real] / size[real, None])
        reach = np.linalg.norm(corners - middles[:, None], axis=2).max(axis=1)
        object.__setattr__(self, "_reach", reach)
        object.__setattr__(self, "_radius", float(reach.max()))
        object.__setattr__(self, "_tree", cKDTree(middles))

    @property
    def exact_normals(self) -> bool:
        """Triangles have normals."""
        return True

    def nearest(self, points_mm: Array) -> tuple[Array, Array]:
        """Return the nearest places on the triangles, exactly, and the directions off them."""
        points = np.asarray(points_mm, np.float64)
        few = min(_CANDIDATES, len(self._corners))
        query = self._tree.query(points, np.arange(1, few + 1))
        away, found = np.asarray(query[0], np.float64), np.asarray(query[1], np.intp)
        face = found[:, 0].copy()
        place = nearest_on_triangles(points, self._corners[face])
        best = np.linalg.norm(place - points, axis=1)
        # A triangle further off by its middle may be nearer by no more than its own reach.
        for start, end in pairwise(sorted({1, min(_FIRST, few), few})):
            owner, which = np.nonzero(
                away[:, start:end] - self._reach[found[:, start:end]] < best[:, None]
            )
            self._look(points, owner, found[owner, start + which], place, face, best)
        rows = np.flatnonzero((few < len(self._corners)) & (away[:, -1] - self._radius < best))
        if len(rows):
            lists = self._tree.query_ball_point(
                points[rows], best[rows] + self._radius * (1.0 + 1e-9)
            )
            owner = np.repeat(rows, [len(one) for one in lists])
            near = np.concatenate([np.asarray(one, np.intp) for one in lists])
            self._look(points, owner, near, place, face, best)
        # Beside an edge or a corner the distance grows along the way to it, not along a normal.
        off = points - place
        length = np.linalg.norm(off, axis=1, keepdims=True)
        tiny = length <= 1e-9 * self._radius
        return place, np.where(tiny, self._units[face], off / np.where(tiny, 1.0, length))

    def _look(
        self,
        points: Array,
        owner: NDArray[np.intp],
        near: NDArray[np.intp],
        place: Array,
        face: NDArray[np.intp],
        best: Array,
    ) -> None:
        """Put in what is nearer, of triangles ``near`` to the points ``owner``."""
        places = nearest_on_triangles(points[owner], self._corners[near])
        distance = np.linalg.norm(places - points[owner], axis=1)
        # The nearest of each point comes first.
        order = np.lexsort((distance, owner))
        rows, first = np.unique(owner[order], return_index=True)
        chosen = order[first]
        nearer = distance[chosen] < best[rows]
        rows, chosen = rows[nearer], chosen[nearer]
        place[rows], face[rows], best[rows] = places[chosen], near[chosen], distance[chosen]


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


def _checked(given: Array, name: str) -> Array:
    array = np.asarray(given, np.float64)
    if array.ndim != 2 or array.shape[1] != 3 or not len(array):
        raise InvalidParameter(f"{name} has shape {array.shape}; it must be (N, 3)")
    if not np.isfinite(array).all():
        raise NonFiniteValue(f"{name} has values that are not finite")
    return array
