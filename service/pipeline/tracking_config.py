"""TrackingConfig: the markers, tools and beam holds that a running device tracks, and how."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from compute.pose.rigid_body import RigidBody
    from compute.pose.settings import ToolTrackerSettings
    from compute.tracking.blink_codes import BlinkCodes
    from compute.tracking.blink_decoding import BlinkModel
    from compute.tracking.settings import TrackerSettings
    from service.pipeline.beam_hold_spec import BeamHoldConfig


@dataclass(frozen=True, eq=False)
class TrackingConfig:
    """What is tracked of a device.

    Args:
        tracks: whether markers are tracked.
        tools: tools whose poses are wanted, in the order of their poses.
        tracker: settings of the marker tracker; None: the defaults.
        tool_tracker: settings of the tool tracker; None: the defaults.
        blinking: codes by which tracks are named, and how the markers show them; None: none.
        holds: its beam holds.
    """

    tracks: bool = False
    tools: tuple["RigidBody", ...] = ()
    tracker: "TrackerSettings | None" = None
    tool_tracker: "ToolTrackerSettings | None" = None
    blinking: "tuple[BlinkCodes, BlinkModel] | None" = None
    holds: "tuple[BeamHoldConfig, ...]" = ()

    @property
    def nothing(self) -> bool:
        """Whether neither markers nor tools are tracked."""
        return not self.tracks and not self.tools


NO_TRACKING: Final = TrackingConfig()
