"""PoseView: the poses of one instant as one client's session gets them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.pose.rigid_body import PoseStatus, ToolPose
from service.api.tools.tip_limit import TipLimit

_GIVEN: Final = (PoseStatus.OK, PoseStatus.OUT_OF_VOLUME)
"""What a client can have, the latter if it asks for it."""
Markers = Callable[[str], NDArray[np.float64] | None]


def _unknown(_: str) -> None:
    return None


@dataclass(frozen=True, eq=False)
class PoseView:
    """The tools of one device.

    Args:
        device_id: the device; None: there is none with tools yet, or it is not clear which.
        several: whether that is because several have tools, and no setting says which.
        tools: names of its tools, in order.
        poses: the newest poses by name; empty where they are old.
        sequence: number of the frame that they are of; -1: there is none.
        fresh: whether they are new.
        frame_rate_hz: of the device; 0: not known.
        markers: returns a tool's markers in its own coordinates, shape (M, 3) [mm]; None: they
            are not known.
        limits: on the error of poses, by the tool's name; tools without one are judged by the
            tracker only.
    """

    device_id: str | None = None
    several: bool = False
    tools: tuple[str, ...] = ()
    poses: Mapping[str, ToolPose] = field(default_factory=dict)
    sequence: int = -1
    fresh: bool = False
    frame_rate_hz: float = 0.0
    markers: Markers = _unknown
    limits: Mapping[str, TipLimit] = field(default_factory=dict)

    def pose(self, tool: str) -> ToolPose | None:
        """Return a tool's pose with the status that it has for a client; None: there is none.

        Besides the pose itself, the one relative to the tool's reference is judged: drivers are
        given both in the world, and form it from them. A reference of another status is
        not given, so that nothing can be formed with it.
        """
        pose, limit = self.poses.get(tool), self.limits.get(tool)
        if pose is None or limit is None:
            return pose
        if pose.status not in _GIVEN:
            return pose
        why = limit.exceeded_reason(pose)
        reference = None if limit.reference is None else self.poses.get(limit.reference)
        if why is None and reference is not None and reference.status in _GIVEN:
            why = limit.exceeded_reason(pose, reference)
        return pose if why is None else replace(pose, status=PoseStatus.HIGH_ERROR, reason=why)


GetPoseView = Callable[[str | None], PoseView]
"""Returns the view of a device; None: of the one that has tools."""
