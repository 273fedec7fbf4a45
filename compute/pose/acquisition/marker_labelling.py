"""Marker labelling: assignment of reconstructed points to tool markers by their distances."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from compute.pose.estimation.pose_initialisation import initial_pose_from_points
from compute.pose.rigid_body import CentredMarkers, RigidBody
from compute.pose.settings import LabellingSettings
from compute.reconstruction.triangulation import chi2_limit
from compute.transform import point_jacobian, rotation_matrix

Array = NDArray[np.float64]

GAUSS_NEWTON_STEPS = 4


@dataclass(frozen=True, eq=False)
class MarkerLabelling:
    """An assignment of points to the markers of a tool, with the fitted pose.

    Args:
        points: index of each marker's point, -1: none, shape (M,).
        rotation: R_world_tool, shape (3, 3).
        centroid_mm: centroid of the tool's markers in the world, shape (3,) [mm].
        covariance: covariance of rotation [rad] and centroid [mm], propagated from the points,
            shape (6, 6).
        chi2: misfit of the points, with 3 n - 6 degrees of freedom.
    """

    points: NDArray[np.intp]
    rotation: Array
    centroid_mm: Array
    covariance: Array
    chi2: float

    @property
    def markers(self) -> int:
        """Number of markers that have a point."""
        return int((self.points >= 0).sum())


@dataclass(frozen=True, eq=False)
class IdentifiedTool:
    """A tool that was identified among points.

    Args:
        tool: its index in the list of tools.
        labelling: the assignment with the most markers and the least chi2.
        ambiguity: another assignment that fits as well, in words; None: there is none.
    """

    tool: int
    labelling: MarkerLabelling
    ambiguity: str | None


def identify_tools(
    tools: Sequence[RigidBody],
    points_mm: Array,
    covariance_mm2: Array,
    settings: LabellingSettings | None = None,
) -> list[IdentifiedTool]:
    """Identify tools among points by the distances between their markers; each point is used once.

    For each tool, all assignments are searched in which as many of its markers as possible have a
    point and all distances agree within the points' covariances. Those to which a rigid motion of
    the tool (no reflection) fits then compete for the points: more markers first, then the lower
    chi2. An identification is ambiguous where another assignment, of the same or another tool,
    fits as well; it is reported as such.

    Args:
        tools: the tools, with their markers.
        points_mm: reconstructed points, shape (N, 3) [mm]; rows of NaN are ignored.
        covariance_mm2: their covariances, shape (N, 3, 3) [mm^2].
        settings: tolerances.

    Returns:
        The identified tools, each at most once.
    """
    settings = settings or LabellingSettings()
    all_labellings = [
        (index, labelling)
        for index, tool in enumerate(tools)
        for labelling in find_labellings(tool, points_mm, covariance_mm2, settings)
    ]
    all_labellings.sort(key=lambda one: (-one[1].markers, one[1].chi2))
    chosen: list[tuple[int, MarkerLabelling]] = []
    free = np.ones(len(points_mm), dtype=np.bool_)
    for index, labelling in all_labellings:
        labelled_points = labelling.points[labelling.points >= 0]
        if any(index == other for other, _ in chosen) or not free[labelled_points].all():
            continue
        free[labelled_points] = False
        chosen.append((index, labelling))
    return [
        IdentifiedTool(
            index, labelling, _ambiguity(tools, index, labelling, all_labellings, chosen, settings)
        )
        for index, labelling in chosen
    ]


def _ambiguity(
    tools: Sequence[RigidBody],
    index: int,
    labelling: MarkerLabelling,
    all_labellings: list[tuple[int, MarkerLabelling]],
    chosen: list[tuple[int, MarkerLabelling]],
    settings: LabellingSettings,
) -> str | None:
    """Return, in words, another assignment that fits as well as the chosen one; None: none does."""
    better = [one for other, one in chosen if other != index and one.markers > labelling.markers]
    for other, rival in all_labellings:
        if rival is labelling or rival.markers < labelling.markers:
            continue
        if rival.chi2 > labelling.chi2 + settings.ambiguity_chi2_margin:
            continue
        if any(_shared_points(rival, one) for one in better):
            continue
        if other == index:
            return (
                f'{labelling.markers} points fit tool "{tools[index].name}" in more than one way: '
                f"chi2 is {labelling.chi2:.3g} and {rival.chi2:.3g}"
            )
        if _shared_points(rival, labelling) >= settings.min_markers:
            return (
                f"the same {_shared_points(rival, labelling)} points fit tool "
                f'"{tools[index].name}" and tool "{tools[other].name}": chi2 is '
                f"{labelling.chi2:.3g} and {rival.chi2:.3g}"
            )
    return None


def _shared_points(first: MarkerLabelling, second: MarkerLabelling) -> int:
    """Return the number of points that two assignments have in common."""
    return len(np.intersect1d(first.points[first.points >= 0], second.points[second.points >= 0]))


def find_labellings(
    tool: RigidBody, points_mm: Array, covariance_mm2: Array, settings: LabellingSettings
) -> list[MarkerLabelling]:
    """Return the assignments of points to a tool's markers with the most markers, best first.

    Args:
        tool: the tool, with M markers.
        points_mm: reconstructed points, shape (N, 3) [mm]; rows of NaN are ignored.
        covariance_mm2: their covariances, shape (N, 3, 3) [mm^2].
        settings: tolerances and the limit of search steps.

    Returns:
        The assignments, lowest chi2 first; empty where none has ``min_markers`` markers that are
        not collinear, or where the search would take more than ``max_search_steps``.
    """
    finite = np.flatnonzero(np.isfinite(points_mm).all(axis=1))
    positions, covariances = points_mm[finite], covariance_mm2[finite]
    if len(finite) < settings.min_markers:
        return []
    fits = _compatible_distances(tool, positions, covariances, settings)
    labellings: list[MarkerLabelling] = []
    max_count = settings.min_markers
    for points in _assignments(fits, settings.min_markers, settings.max_search_steps):
        if points is None:
            return []
        count = int((points >= 0).sum())
        if count < max_count:
            continue
        labelling = _fit_labelling(tool, points, positions, covariances, settings)
        if labelling is not None:
            labellings = [labelling] if count > max_count else [*labellings, labelling]
            max_count = count
    # Indices into all points.
    labellings = [
        replace(one, points=np.where(one.points >= 0, finite[one.points], -1)) for one in labellings
    ]
    return sorted(labellings, key=lambda one: one.chi2)


def _compatible_distances(
    tool: RigidBody, points_mm: Array, covariance_mm2: Array, settings: LabellingSettings
) -> NDArray[np.bool_]:
    """Return whether the distance of markers i, j agrees with that of points a, b, (M, M, N, N)."""
    markers = np.asarray(tool.markers_mm, dtype=np.float64)
    marker_distance = np.linalg.norm(markers[:, None] - markers[None], axis=-1)
    apart = points_mm[:, None] - points_mm[None]
    distance = np.linalg.norm(apart, axis=-1)
    along = apart / np.maximum(distance, 1e-9)[..., None]
    both = covariance_mm2[:, None] + covariance_mm2[None]
    variance = np.einsum("abi,abij,abj->ab", along, both, along) + 2.0 * settings.marker_sigma_mm**2
    tolerance = -float(ndtri(0.5 * settings.gate_probability)) * np.sqrt(variance)
    fits: NDArray[np.bool_] = np.abs(distance - marker_distance[:, :, None, None]) <= tolerance
    fits &= ~np.eye(len(points_mm), dtype=np.bool_)
    return fits


def _assignments(
    fits: NDArray[np.bool_], least: int, max_steps: int
) -> Iterator[NDArray[np.intp] | None]:
    """Yield points of markers (-1: none) whose distances all agree; more markers first.

    Assignments with fewer markers than an earlier one are skipped. After too many steps it yields
    None and ends.
    """
    markers, points = len(fits), fits.shape[2]
    most, steps = least, 0
    assigned = np.full(markers, -1, dtype=np.intp)

    def extend(marker: int, count: int, open_points: NDArray[np.bool_]) -> Iterator[None]:
        nonlocal most, steps
        steps += 1
        if steps > max_steps or count + markers - marker < most:
            return
        if marker == markers:
            most = max(most, count)
            yield None
            return
        candidates = open_points[marker]
        for point in np.flatnonzero(candidates):
            assigned[marker] = point
            # Later markers: only points whose distance from this one agrees.
            compatible_points = open_points & fits[marker, :, point, :]
            yield from extend(marker + 1, count + 1, compatible_points)
        assigned[marker] = -1
        yield from extend(marker + 1, count, open_points)

    for _ in extend(0, 0, np.ones((markers, points), dtype=np.bool_)):
        yield assigned.copy()
    if steps > max_steps:
        yield None


def _fit_labelling(
    tool: RigidBody,
    points: NDArray[np.intp],
    positions_mm: Array,
    covariance_mm2: Array,
    settings: LabellingSettings,
) -> MarkerLabelling | None:
    """Fit the pose of a tool to its points by weighted least squares; None: chi2 is too large."""
    centred = CentredMarkers.of(tool)
    labelled = np.flatnonzero(points >= 0)
    markers, target = centred.markers_mm[labelled], positions_mm[points[labelled]]
    start = initial_pose_from_points(markers, target)
    if start is None:
        return None
    rotation, centroid = start
    inverse = np.linalg.inv(
        covariance_mm2[points[labelled]] + settings.marker_sigma_mm**2 * np.eye(3)
    )
    for _ in range(GAUSS_NEWTON_STEPS):
        arms = markers @ rotation.T
        jacobian = point_jacobian(arms)
        weighted = jacobian.transpose(0, 2, 1) @ inverse
        normal = (weighted @ jacobian).sum(axis=0)
        rest = target - arms - centroid
        step = np.linalg.solve(normal, np.einsum("nij,nj->i", weighted, rest))
        rotation, centroid = rotation_matrix(step[:3]) @ rotation, centroid + step[3:]
    rest = target - markers @ rotation.T - centroid
    chi2 = float(np.einsum("ni,nij,nj->", rest, inverse, rest))
    if not chi2 <= chi2_limit(3 * len(labelled) - 6, settings.gate_probability):
        return None
    return MarkerLabelling(points, rotation, centroid, np.linalg.inv(normal), chi2)
