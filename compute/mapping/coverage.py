"""Gaps between measurements: holes, beside the measurements' own local spacing."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, Delaunay, QhullError, Voronoi, cKDTree

from compute.camera.model import vector3
from compute.mapping.grid import mesh_points
from compute.mapping.result import Hole

Array = NDArray[np.float64]

GAPS_PER_FEATURE = 2.0
"""Full width at half maximum of the narrowest feature that is resolved, in diameters of the largest
gap. Of a Gaussian of two sampling distances 3 % of the height lie beyond the Nyquist frequency, of
one of a single distance 40 %."""
MAX_HOLE_RATIO = 1.4
"""Radius of an empty ball, over the local spacing, from which it is a hole: among points at random
one in 10^5 balls of this volume is empty, exp(-4/3 pi 1.4^3)."""
TYPICAL_QUANTILE = 0.95
REGULARITY_FACTOR = 1.45
"""Among more regular points smaller balls are holes: those of this many times the radius that 95 %
of the volume does not reach. For points at random both limits are the same."""
MEDIAN_FACTOR = 1.7
"""Largest ratio of that radius to the median one in sets without holes: 1.6 for points at random,
1.75 in slices."""
_PASSES = 4
_FACET_STEPS = 8
MAX_NODES = 30_000
"""Largest number of positions at which gaps are looked for."""
_NODES_PER_SPACING = 2.5
_NEIGHBOURS = 12
_GAP_QUANTILE = 1.0 / 3.0
"""Of the gaps at a measurement: at the rim of a hole up to a half of them lead into it."""
_NEAREST = 12


@dataclass(frozen=True, eq=False)
class Coverage:
    """Spacing of one sensor's measurements and the holes that they leave.

    Args:
        points_mm: the measurements, shape (N, 3) [mm].
        spacing_mm: local spacing at each, shape (N,) [mm].
        hole_centres_mm: centres of empty balls that are holes, shape (B, 3) [mm].
        hole_radii_mm: their radii, shape (B,) [mm].
        largest_gap_mm: diameter of the largest empty ball within the hull that is no hole [mm].
    """

    points_mm: Array
    spacing_mm: Array
    hole_centres_mm: Array
    hole_radii_mm: Array
    largest_gap_mm: float

    @classmethod
    def of(cls, points_mm: Array) -> "Coverage":
        """Find the holes between points (N, 3) [mm], within their convex hull.

        A hole is a ball without measurements whose volume within the hull is that of a ball with a
        radius of MAX_HOLE_RATIO local spacings, or of fewer among regular points. The local spacing
        is the larger of that of the nearest measurements and of that of what is measured around
        the ball: where dense points border on sparse ones, the gaps of these are no holes.
        """
        nodes, volume = _hull_nodes(points_mm)
        spacing = local_spacing(points_mm, nodes, volume)
        if not len(nodes):
            return cls(points_mm, spacing, np.empty((0, 3)), np.empty(0), 0.0)
        tree = cKDTree(points_mm)
        found = tree.query(nodes, k=min(_NEAREST, len(points_mm)))
        distance, nearest = np.asarray(found[0]), np.asarray(found[1])
        radius = distance[:, 0]
        wide_spacing = spacing[nearest].max(axis=1)
        hole = _find_holes(tree, nodes, volume, radius, wide_spacing)
        found_holes = cls(points_mm, spacing, nodes[hole], radius[hole], 0.0)
        gap_centres = _gap_centres(points_mm)
        gap_centres = gap_centres[~found_holes.in_hole(gap_centres)]
        largest_gap = np.asarray(tree.query(gap_centres)[0]).max(initial=0.0)
        largest_gap = max(largest_gap, np.where(hole, 0.0, radius).max())
        return replace(found_holes, largest_gap_mm=2.0 * float(largest_gap))

    @property
    def resolution_mm(self) -> float:
        """Full width at half maximum of the narrowest feature that is resolved [mm]."""
        return GAPS_PER_FEATURE * self.largest_gap_mm

    @property
    def largest_hole(self) -> "Hole | None":
        """The hole with the largest empty ball; None without holes."""
        if not len(self.hole_radii_mm):
            return None
        largest = int(np.argmax(self.hole_radii_mm))
        centre = vector3(self.hole_centres_mm[largest])
        return Hole(centre, 2.0 * float(self.hole_radii_mm[largest]))

    def in_hole(self, positions_mm: Array, margin_mm: float = 0.0) -> NDArray[np.bool_]:
        """Return which positions (M, 3) [mm] lie in a hole or within a margin of one, shape (M,).

        Args:
            positions_mm: shape (M, 3) [mm].
            margin_mm: the margin [mm].
        """
        inside = np.zeros(len(positions_mm), dtype=np.bool_)
        tree = cKDTree(positions_mm)
        order = np.argsort(-self.hole_radii_mm)
        for centre, radius in zip(
            self.hole_centres_mm[order], self.hole_radii_mm[order], strict=True
        ):
            inside[tree.query_ball_point(centre, radius + margin_mm)] = True
        return inside


def local_spacing(points_mm: Array, nodes_mm: Array, node_volume: float) -> Array:
    """Return the distance between neighbours around each of N points, shape (N,) [mm].

    The larger of two, each a low quantile over the nearest neighbours, so that the rim of a hole
    takes its spacing from the side that was measured: the edge of the cube that each point has in
    the smallest ball of _NEIGHBOURS, without what lies beyond the hull; and the radius of the empty
    balls (of the Delaunay tetrahedra) at the points, which is larger in scan lines and slices.

    Args:
        points_mm: shape (N, 3) [mm].
        nodes_mm: a lattice within the points' hull, shape (M, 3) [mm].
        node_volume: volume of each node [mm^3].
    """
    count = min(_NEIGHBOURS, len(points_mm) - 1)
    tree = cKDTree(points_mm)
    found = tree.query(points_mm, k=count + 1)
    distance, neighbours = np.asarray(found[0]), np.asarray(found[1])
    ball = 4.0 / 3.0 * np.pi * distance[:, -1] ** 3
    if len(nodes_mm):
        lattice = cKDTree(nodes_mm)
        within = lattice.query_ball_point(points_mm, distance[:, -1], return_length=True)
        ball = np.minimum(ball, np.maximum(within * node_volume, ball / 8.0))
    spacing = np.cbrt(ball / (count + 0.5))
    gap = _gap_radii(points_mm)
    typical = [np.quantile(values[neighbours], _GAP_QUANTILE, axis=1) for values in (spacing, gap)]
    return np.asarray(np.maximum(*typical))


def _find_holes(
    tree: cKDTree, nodes: Array, volume: float, radius: Array, spacing: Array
) -> NDArray[np.bool_]:
    """Return at which nodes the empty ball is a hole, shape (M,).

    A hole widens the typical gap by which it is judged: the first pass takes this from the median,
    which it widens least, and the following ones from what lies outside the holes found so far.

    Args:
        tree: the measurements.
        nodes: a lattice within their hull, shape (M, 3) [mm].
        volume: volume of a node [mm^3].
        radius: of the empty balls around the nodes, shape (M,) [mm].
        spacing: local spacing there, shape (M,) [mm].
    """
    ratio = radius / spacing
    typical = float(np.quantile(ratio, TYPICAL_QUANTILE))
    typical = min(typical, MEDIAN_FACTOR * float(np.median(ratio)))
    hole = np.zeros(len(nodes), dtype=np.bool_)
    for _ in range(_PASSES):
        limit = min(MAX_HOLE_RATIO, REGULARITY_FACTOR * typical) * spacing
        wide = np.flatnonzero(radius > limit)
        within, around = _ball_volumes(nodes, radius, volume, wide)
        number = tree.query_ball_point(nodes[wide], 2.0 * radius[wide], return_length=True)
        measured = limit[wide] / spacing[wide] * np.cbrt(around / number)
        found = np.zeros_like(hole)
        found[wide] = np.cbrt(0.75 / np.pi * within) > np.maximum(limit[wide], measured)
        if not found.any() or (found == hole).all():
            return found
        hole = found
        outside = np.ones_like(hole)
        for near in cKDTree(nodes).query_ball_point(nodes[hole], radius[hole]):
            outside[near] = False
        if not outside.any():
            return hole
        typical = min(typical, float(np.quantile(ratio[outside], TYPICAL_QUANTILE)))
    return hole


def _gap_centres(points_mm: Array) -> Array:
    """Return candidates for centres of the largest empty balls, shape (C, 3) [mm].

    The Voronoi vertices within the hull of points (N, 3), and places on the hull's facets.
    """
    try:
        vertices = Voronoi(points_mm, qhull_options="Qbb Qc Qz QJ").vertices
        hull = ConvexHull(points_mm)
    except QhullError:
        return np.empty((0, 3))
    inside = np.ones(len(vertices), dtype=np.bool_)
    for x, y, z, offset in hull.equations:
        inside &= vertices @ (x, y, z) + offset <= 0.0
    steps = range(_FACET_STEPS + 1)
    weights = np.array(
        [(i, j, _FACET_STEPS - i - j) for i in steps for j in steps if i + j <= _FACET_STEPS]
    )
    on_facets = np.einsum("wc,fcx->fwx", weights / _FACET_STEPS, points_mm[hull.simplices])
    return np.concatenate([vertices[inside], on_facets.reshape(-1, 3)])


def _gap_radii(points_mm: Array) -> Array:
    """Return a low quantile of the radii of the empty balls that touch each point, shape (N,)."""
    try:
        simplices = Delaunay(points_mm, qhull_options="QJ").simplices
    except QhullError:
        return np.zeros(len(points_mm))
    corners = points_mm[simplices]
    edges = corners[:, 1:] - corners[:, :1]
    flat = np.abs(np.linalg.det(edges)) < 1e-6 * np.linalg.norm(edges, axis=2).prod(axis=1)
    centre = np.linalg.solve(
        np.where(flat[:, None, None], np.eye(3), edges), 0.5 * (edges**2).sum(axis=2)[..., None]
    )[..., 0]
    radius = np.where(flat, np.inf, np.linalg.norm(centre, axis=1))
    touched, owner = np.repeat(radius, 4), simplices.ravel()
    order = np.lexsort((touched, owner))
    first = np.searchsorted(owner[order], np.arange(len(points_mm)))
    number = np.bincount(owner, minlength=len(points_mm))
    chosen = first + (number * _GAP_QUANTILE).astype(np.intp)
    found = np.where(number > 0, touched[order][np.minimum(chosen, len(order) - 1)], 0.0)
    return np.where(np.isfinite(found), found, 0.0)


def _ball_volumes(
    nodes: Array, radius: Array, volume: float, chosen: NDArray[np.intp]
) -> tuple[Array, Array]:
    """Return volumes within the hull around chosen nodes: empty, and measured around that.

    Args:
        nodes: a lattice within the hull, shape (M, 3) [mm].
        radius: of the empty balls around them, shape (M,) [mm].
        volume: volume of a node [mm^3].
        chosen: indices of C nodes.

    Returns:
        Volume of the empty ball, and of what lies within twice its radius and nearer than half of
        it to a measurement, both of shape (C,) [mm^3].
    """
    lattice = cKDTree(nodes)
    within, around = np.empty(len(chosen)), np.empty(len(chosen))
    for k, node in enumerate(chosen):
        near = lattice.query_ball_point(nodes[node], 2.0 * radius[node])
        distance = np.linalg.norm(nodes[near] - nodes[node], axis=1)
        within[k] = np.count_nonzero(distance < radius[node])
        around[k] = np.count_nonzero(radius[near] < 0.5 * radius[node])
    return within * volume, around * volume


def _hull_nodes(points_mm: Array) -> tuple[Array, float]:
    """Return a lattice within the hull, shape (M, 3) [mm], and the volume of a node [mm^3]."""
    try:
        hull = ConvexHull(points_mm)
    except QhullError:
        return np.empty((0, 3)), 0.0
    low, high = points_mm.min(axis=0), points_mm.max(axis=0)
    step = np.cbrt(hull.volume / len(points_mm)) / _NODES_PER_SPACING
    step = max(step, float(np.cbrt((high - low).prod() / MAX_NODES)))
    numbers = np.maximum(np.rint((high - low) / step), 1.0).astype(int)
    axes = [
        a + (np.arange(number) + 0.5) * (b - a) / number
        for a, b, number in zip(low, high, numbers, strict=True)
    ]
    nodes = mesh_points(axes)
    inside = (nodes @ hull.equations[:, :3].T + hull.equations[:, 3] <= 0.0).all(axis=1)
    return nodes[inside], float(((high - low) / numbers).prod())
