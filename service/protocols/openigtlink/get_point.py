"""The points that GET_POINT asks for: markers and tips of the tools that are seen, landmarks."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.pipeline.transform_names import frame_name
from service.protocols.openigtlink.host import Landmark, WireTool
from service.protocols.openigtlink.pose_bodies import Point
from service.protocols.openigtlink.snapshot import Snapshot, WirePose

Array = NDArray[np.float64]

_MARKER = (255, 255, 0, 255)
_TIP = (255, 0, 0, 255)
_LANDMARK = (0, 255, 0, 255)


@dataclass(frozen=True)
class PointReply:
    """What there is of what was asked for.

    Args:
        points: that can be given.
        void: why landmarks are not given any more, each registration once.
        bound: whether landmarks are given that hold only as long as nothing else is active.
    """

    points: tuple[Point, ...]
    withheld: tuple[str, ...] = ()
    has_landmarks: bool = False


def find_points(
    name: str,
    snapshot: Snapshot,
    tools: Sequence[WireTool],
    landmarks: Sequence[Landmark],
) -> PointReply:
    """Return the points of a name, in the frame that poses of their tool are given in.

    Args:
        name: of a tool, its transform, ``Landmarks``, ``Markers``; empty: all.
        snapshot: the newest poses; markers of tools that are not seen have no place.
        tools: of the device.
        landmarks: likewise; those that were measured with what is not active are withheld.
    """
    points: list[Point] = []
    by_id = {tool.id: tool for tool in tools}
    for pose in snapshot.poses:
        tool = by_id.get(pose.source.tool)
        names = (pose.name.short, pose.name.full, pose.source.tool, "Markers", "")
        if tool is not None and pose.valid and pose.placed is not None and name in names:
            points += _of_tool(tool, pose, pose.placed)
    in_force = snapshot.entry.calibration_id, snapshot.entry.table_id
    withheld: dict[str, None] = {}
    has_landmarks = False
    for one in landmarks:
        if name not in ("", "Landmarks", one.owner, one.name):
            continue
        why = None if one.provenance is None else one.provenance.invalid_reason(*in_force)
        if why is not None:
            withheld[why] = None
            continue
        has_landmarks = has_landmarks or one.provenance is not None
        points.append(Point(one.name, "Landmark", one.position_mm, _LANDMARK, owner=one.owner))
    return PointReply(tuple(points), tuple(withheld), has_landmarks)


def _of_tool(tool: WireTool, pose: WirePose, placed: tuple[Array, Array]) -> Iterable[Point]:
    owner = frame_name(pose.name.frame)
    if tool.markers_mm is not None:
        for number, marker in enumerate(tool.markers_mm):
            place = _transform(placed, marker)
            yield Point(f"{tool.id} marker {number}", "Marker", place, _MARKER, owner=owner)
    if tool.tip_mm is not None:
        yield Point(f"{tool.id} tip", "Tip", _transform(placed, tool.tip_mm), _TIP, owner=owner)


def _transform(placed: tuple[Array, Array], point_mm: Array) -> tuple[float, float, float]:
    rotation, translation = placed
    x, y, z = rotation @ point_mm + translation
    return float(x), float(y), float(z)
