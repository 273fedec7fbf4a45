"""View: what one client's session sees of the poses at an instant."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from compute.pose.tool_pose import ToolPose

Markers = Callable[[str], NDArray[np.float64] | None]


def _unknown(_: str) -> None:
    return None


@dataclass(frozen=True, eq=False)
class View:
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
    """

    device_id: str | None = None
    several: bool = False
    tools: tuple[str, ...] = ()
    poses: Mapping[str, ToolPose] = field(default_factory=dict)
    sequence: int = -1
    fresh: bool = False
    frame_rate_hz: float = 0.0
    markers: Markers = _unknown


Look = Callable[[str | None], View]
"""Returns the view of a device; None: of the one that has tools."""
