"""TrackingConfig: the markers, tools and beam holds that a running device tracks, and how."""

from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray

from compute.pose.beam_hold import BeamHoldLimits
from compute.transform import Transform

if TYPE_CHECKING:
    from compute.pose.rigid_body import RigidBody
    from compute.pose.settings import ToolTrackerSettings
    from compute.tracking.blink_codes import BlinkCodes
    from compute.tracking.blink_decoding import BlinkModel
    from compute.tracking.settings import TrackerSettings


Array = NDArray[np.float64]


@dataclass(frozen=True)
class WatchedTool:
    """A tool whose pose is watched.

    Args:
        tool: its id.
        target_mm: the point to be irradiated, in the tool's coordinates [mm].
        axes: R_axes_world of the axes of ``axis_mm``, by rows; None: the world's.
    """

    tool: str
    target_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axes: tuple[tuple[float, float, float], ...] | None = None
    count: ClassVar[int] = 1


@dataclass(frozen=True)
class WatchedStrobedMarkers:
    """Markers that are watched one by one, as they are strobed.

    Args:
        markers: their numbers.
        min_markers: with fewer of them seen, nothing was measured.
    """

    markers: tuple[int, ...]
    min_markers: int

    @property
    def count(self) -> int:
        """Number of targets that are watched."""
        return len(self.markers)


@dataclass(frozen=True)
class WatchedLitMarkers:
    """Markers that are lit together, identified by their reference positions.

    Args:
        markers: how many.
        min_markers: with fewer of them seen, nothing was measured.
        search_radius_mm: how far from its place a marker is looked for [mm].
        observed_as: points of each frame, or tracks.
    """

    markers: int
    min_markers: int
    search_radius_mm: float
    observed_as: Literal["points", "tracks"] = "points"

    @property
    def count(self) -> int:
        """Number of targets that are watched."""
        return self.markers


Spec = WatchedTool | WatchedStrobedMarkers | WatchedLitMarkers


@dataclass(frozen=True, eq=False)
class HoldReference:
    """Reference of a hold: pose or marker positions at set-up.

    Args:
        id: another for each reference that was taken.
        at: when it was.
        calibration_id: then active; the places mean something in its world only.
        table_id: the correction table then active.
        pose: T_world_tool, of a tool.
        positions_mm: of markers, shape (M, 3) [mm].
        covariances_mm2: of these, shape (M, 3, 3) [mm^2].
    """

    id: str
    at: datetime
    calibration_id: str | None
    table_id: str | None
    pose: Transform | None = None
    positions_mm: Array | None = None
    covariances_mm2: Array | None = None


@dataclass(frozen=True, eq=False)
class BeamHoldConfig:
    """A beam hold of a device.

    Args:
        id: its id.
        device_id: the device.
        key: another for anything that is not the same in the members below.
        spec: what is watched.
        limits: how far it may move, and the rules.
        reference: how it was at set-up; None: nobody has said, and the beam is held.
    """

    id: str
    device_id: str
    key: str
    spec: Spec
    limits: BeamHoldLimits
    reference: HoldReference | None = None


@dataclass(frozen=True, eq=False)
class TrackingConfig:
    """Markers and tools of a device to track, with the settings.

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
