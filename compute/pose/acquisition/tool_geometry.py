"""Tool geometry: checks that markers determine a pose and distinguish tools."""

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


def check_tool(tool: RigidBody) -> None:
    """Refuse a tool whose markers do not determine its pose.

    Strobed markers are identified by their slots: they may be close together or symmetric.

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
    principal = np.linalg.svd(markers - markers.mean(axis=0), compute_uv=False)
    width = float(np.sqrt((principal[1:] ** 2).sum() / len(markers)))
    if width < MIN_WIDTH_MM:
        raise DegenerateTool(
            f'the markers of tool "{tool.name}" lie on a line, to {width:.3g} mm RMS: the turn '
            f"about it is not determined; move one so that it is {MIN_WIDTH_MM:g} mm or more",
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
        if distance < MIN_DISTANCE_MM:
            raise DegenerateTool(
                f'markers {first + 1} and {second + 1} of tool "{tool.name}" are {distance:.3g} mm '
                f"apart; lit together they must be {MIN_DISTANCE_MM:g} mm or more apart, or "
                "their lines merge",
                distance_mm=distance,
                markers=(first + 1, second + 1),
            )
    exchanged = exchangeable_markers(tool)
    if exchanged:
        raise DegenerateTool(
            f'tool "{tool.name}" looks the same with its markers exchanged ({exchanged[0]}): their '
            f"distances agree within {POINT_SIGMA_MM:g} mm of noise; move one, or strobe them",
            exchanged=exchanged,
        )


def exchangeable_markers(tool: RigidBody) -> list[str]:
    """Return the permutations under which a tool's markers look the same within the noise.

    Returns:
        Each permutation in words, such as "1 as 2, 2 as 1".
    """
    markers = _markers(tool)
    orders = (
        enumerate(labelling.points.tolist())
        for labelling in _labellings_on(tool, markers, len(markers))
    )
    exchanged = (
        ", ".join(f"{marker + 1} as {point + 1}" for marker, point in order if marker != point)
        for order in orders
    )
    return [permutation for permutation in exchanged if permutation]


def check_distinguishable(tools: Sequence[RigidBody]) -> None:
    """Refuse tools that can be mistaken for one another.

    Args:
        tools: tools of one device; strobed ones are compared by their slots only.

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
        alike = _labellings_on(first, _markers(second), MIN_MARKERS)
        if alike:
            pairs = _matching_distances(first, second, alike[0])
            raise IndistinguishableTools(
                f'tools "{first.name}" and "{second.name}" look alike within '
                f"{POINT_SIGMA_MM:g} mm of noise: {'; '.join(pairs)}; move a marker of one so "
                f"that no {MIN_MARKERS} markers have the same distances",
                tools=(first.name, second.name),
                pairs=pairs,
            )


def _labellings_on(tool: RigidBody, markers_mm: Array, min_markers: int) -> list[MarkerLabelling]:
    """Return the assignments of a tool to the markers of another, as noisy as points."""
    covariance = np.broadcast_to(POINT_SIGMA_MM**2 * np.eye(3), (len(markers_mm), 3, 3))
    # Three sigma: tools that look alike in one of three hundred frames are ambiguous.
    settings = LabellingSettings(
        min_markers=min_markers, gate_probability=2.7e-3, marker_sigma_mm=POINT_SIGMA_MM
    )
    return find_labellings(tool, markers_mm, covariance, settings)


def _matching_distances(
    first: RigidBody, second: RigidBody, labelling: MarkerLabelling
) -> list[str]:
    """Return the alike distances of two tools in words."""

    def distance(tool: RigidBody, one: int, other: int) -> float:
        return float(np.linalg.norm(tool.markers_mm[one] - tool.markers_mm[other]))

    matches = [match for match in enumerate(labelling.points.tolist()) if match[1] >= 0]
    return [
        f"markers {a + 1} and {b + 1} of the first are {distance(first, a, b):.2f} mm apart, "
        f"{p + 1} and {q + 1} of the second {distance(second, p, q):.2f} mm"
        for (a, p), (b, q) in combinations(matches, 2)
    ]


def _markers(tool: RigidBody) -> Array:
    markers = np.asarray(tool.markers_mm, dtype=np.float64)
    if not np.isfinite(markers).all():
        bad = int(np.flatnonzero(~np.isfinite(markers).all(axis=1))[0])
        raise NonFiniteValue(
            f'marker {bad + 1} of tool "{tool.name}" is {markers[bad].tolist()}; it must be finite'
        )
    return markers
