"""Tool geometry: whether markers determine a pose and tell tools apart."""

from collections.abc import Sequence
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import DegenerateTool, IndistinguishableTools, NonFiniteValue
from compute.pose.acquisition.marker_labelling import MarkerLabelling, find_labellings
from compute.pose.rigid_body import RigidBody
from compute.pose.settings import LabellingSettings

Array = NDArray[np.float64]

MIN_MARKERS: Final = 3
MIN_WIDTH_MM: Final = 5.0
"""Least RMS distance of the markers from the line through them: with 0.1 mm of noise the rotation
about the line is known to a degree."""
MIN_DISTANCE_MM: Final = 5.0
"""Least distance of markers that are lit together: lines of nearer ones merge at most positions."""
POINT_SIGMA_MM: Final = 0.25
"""Standard deviation of a reconstructed point under poor conditions."""


def check_tool(
    tool: RigidBody,
    *,
    min_width_mm: float = MIN_WIDTH_MM,
    min_distance_mm: float = MIN_DISTANCE_MM,
    point_sigma_mm: float = POINT_SIGMA_MM,
) -> None:
    """Refuse a tool whose markers do not determine its pose.

    Strobed markers are identified by their slots: they may be close together or symmetric.

    Args:
        tool: a new tool.
        min_width_mm: least RMS distance of its markers from the line of best fit [mm].
        min_distance_mm: least distance between two markers that are lit together [mm].
        point_sigma_mm: standard deviation of reconstructed points [mm].

    Raises:
        NonFiniteValue: a coordinate is NaN or infinite.
        DegenerateTool: fewer than three markers; markers on a line, too close together, or so
            symmetric that they can be exchanged.
    """
    markers = _markers(tool)
    if len(markers) < MIN_MARKERS:
        raise DegenerateTool(
            f'tool "{tool.name}" has {len(markers)} markers; a pose takes {MIN_MARKERS} or more '
            "that are not on a line",
            markers=len(markers),
        )
    width = _width_mm(markers)
    if width < min_width_mm:
        raise DegenerateTool(
            f'the markers of tool "{tool.name}" lie on a line, to {width:.3g} mm RMS: nothing '
            f"tells the turn about it; move one so that it is {min_width_mm:g} mm or more",
            width_mm=width,
        )
    if tool.strobe_markers is not None:
        if len(set(tool.strobe_markers)) != len(tool.strobe_markers):
            raise DegenerateTool(
                f'the strobe slots of tool "{tool.name}" are {list(tool.strobe_markers)}; they '
                "must all be different",
                strobe_markers=tool.strobe_markers,
            )
        return
    for first, second in combinations(range(len(markers)), 2):
        distance = float(np.linalg.norm(markers[first] - markers[second]))
        if distance < min_distance_mm:
            raise DegenerateTool(
                f'markers {first + 1} and {second + 1} of tool "{tool.name}" are {distance:.3g} mm '
                f"apart; lit together they must be {min_distance_mm:g} mm or more apart, or "
                "their lines merge",
                distance_mm=distance,
                markers=(first + 1, second + 1),
            )
    exchanged = exchangeable_markers(tool, point_sigma_mm)
    if exchanged:
        raise DegenerateTool(
            f'tool "{tool.name}" looks the same with its markers exchanged ({exchanged[0]}): their '
            f"distances agree within {point_sigma_mm:g} mm of noise; move one, or strobe them",
            exchanged=exchanged,
        )


def exchangeable_markers(tool: RigidBody, point_sigma_mm: float = POINT_SIGMA_MM) -> list[str]:
    """Return the permutations under which a tool's markers look the same within the noise.

    Args:
        tool: the tool.
        point_sigma_mm: standard deviation of a reconstructed point [mm].

    Returns:
        Each permutation in words, such as "1 as 2, 2 as 1".
    """
    markers = _markers(tool)
    found = _labellings_on(tool, markers, point_sigma_mm, len(markers))
    orders = [labelling.points.tolist() for labelling in found]
    same = list(range(len(markers)))
    return [
        ", ".join(
            f"{marker + 1} as {point + 1}" for marker, point in enumerate(order) if marker != point
        )
        for order in orders
        if order != same
    ]


def check_distinguishable(
    tools: Sequence[RigidBody],
    *,
    point_sigma_mm: float = POINT_SIGMA_MM,
    min_markers: int = MIN_MARKERS,
) -> None:
    """Refuse tools that can be mistaken for one another.

    Args:
        tools: tools of one device; strobed ones are compared by their slots only.
        point_sigma_mm: standard deviation of reconstructed points [mm].
        min_markers: number of markers that identify a tool; as many congruent markers are refused.

    Raises:
        IndistinguishableTools: two tools have congruent subsets of markers, or share a strobe slot.
        NonFiniteValue: a coordinate is NaN or infinite.
    """
    for first, second in combinations(tools, 2):
        if first.strobe_markers is not None and second.strobe_markers is not None:
            shared = sorted(set(first.strobe_markers) & set(second.strobe_markers))
            if shared:
                raise IndistinguishableTools(
                    f'tools "{first.name}" and "{second.name}" share the strobe slots {shared}; '
                    "each marker needs its own",
                    tools=(first.name, second.name),
                    strobe_markers=shared,
                )
        if first.strobe_markers is not None or second.strobe_markers is not None:
            continue
        alike = _labellings_on(first, _markers(second), point_sigma_mm, min_markers)
        if alike:
            pairs = _matching_distances(first, second, alike[0])
            raise IndistinguishableTools(
                f'tools "{first.name}" and "{second.name}" look alike within '
                f"{point_sigma_mm:g} mm of noise: {'; '.join(pairs)}; move a marker of one so "
                f"that no {min_markers} "
                "markers have the same distances",
                tools=(first.name, second.name),
                pairs=pairs,
            )


def _labellings_on(
    tool: RigidBody, markers_mm: Array, point_sigma_mm: float, least: int
) -> list[MarkerLabelling]:
    """Return the assignments of a tool to the markers of another, as noisy as points."""
    covariance = np.broadcast_to(point_sigma_mm**2 * np.eye(3), (len(markers_mm), 3, 3))
    # Three sigma: tools that look alike in one of three hundred frames are ambiguous.
    settings = LabellingSettings(
        min_markers=max(least, MIN_MARKERS), gate_probability=2.7e-3, marker_sigma_mm=point_sigma_mm
    )
    return find_labellings(tool, markers_mm, covariance, settings)


def _matching_distances(
    first: RigidBody, second: RigidBody, labelling: MarkerLabelling
) -> list[str]:
    """Return the alike distances of two tools in words."""
    own = np.flatnonzero(labelling.points >= 0)
    found = []
    for one, other in combinations(own.tolist(), 2):
        there, then = int(labelling.points[one]), int(labelling.points[other])
        here_mm = float(np.linalg.norm(first.markers_mm[one] - first.markers_mm[other]))
        there_mm = float(np.linalg.norm(second.markers_mm[there] - second.markers_mm[then]))
        found.append(
            f"markers {one + 1} and {other + 1} of the first are {here_mm:.2f} mm apart, "
            f"{there + 1} and {then + 1} of the second {there_mm:.2f} mm"
        )
    return found


def _markers(tool: RigidBody) -> Array:
    markers = np.asarray(tool.markers_mm, dtype=np.float64)
    if not np.isfinite(markers).all():
        bad = int(np.flatnonzero(~np.isfinite(markers).all(axis=1))[0])
        raise NonFiniteValue(
            f'marker {bad + 1} of tool "{tool.name}" is {markers[bad].tolist()}; it must be finite'
        )
    return markers


def _width_mm(markers_mm: Array) -> float:
    """Return the RMS distance from the line that fits markers best [mm]."""
    spread = np.linalg.svd(markers_mm - markers_mm.mean(axis=0), compute_uv=False)
    return float(np.sqrt((spread[1:] ** 2).sum() / len(markers_mm)))
