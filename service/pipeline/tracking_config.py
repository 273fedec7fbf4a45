"""Tracked: what of a running device is followed, markers and tools, and how."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from compute.pose.rigid_body import RigidBody
    from compute.pose.settings import ToolTrackerSettings
    from compute.tracking.blink_decoding import BlinkCodes, BlinkModel
    from compute.tracking.factory import TrackingSettings
    from service.pipeline.beam_hold_spec import BeamHoldConfig


@dataclass(frozen=True, eq=False)
class TrackingConfig:
    """What a device follows.

    Args:
        tracks: whether markers are followed as tracks.
        tools: tools whose poses are wanted, in the order of their poses.
        tracker: how markers are followed; None: by default.
        tool_tracker: how tools are followed; None: by default.
        blinking: codes by which tracks are named, and how the markers show them; None: none.
        holds: beam holds that watch what is seen of it.
    """

    tracks: bool = False
    tools: tuple["RigidBody", ...] = ()
    tracker: "TrackingSettings | None" = None
    tool_tracker: "ToolTrackerSettings | None" = None
    blinking: "tuple[BlinkCodes, BlinkModel] | None" = None
    holds: "tuple[BeamHoldConfig, ...]" = ()

    @property
    def nothing(self) -> bool:
        """Whether there is nothing to follow."""
        return not self.tracks and not self.tools


NO_TRACKING: Final = TrackingConfig()
