"""Followers: the trackers of markers and of tools, as the live path makes and calls them."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.pose.rigid_body import RigidBody
from compute.pose.tool_pose import ToolPose
from compute.reconstruction.estimate import PointBatch
from compute.tracking.track_batch import TrackBatch
from service.live.frame_points import ActiveCalibration
from service.live.tracked import Tracked

if TYPE_CHECKING:
    from compute.mapping.table import CorrectionTable

Array = NDArray[np.float64]


class MarkerFollower(Protocol):
    """Follows markers from frame to frame; see compute/tracking/methods.py."""

    def step(
        self,
        time_ns: int,
        position_px: Array,
        sigma_px: Array,
        peak_flags: NDArray[np.int32],
        marker: int | None,
    ) -> TrackBatch:
        """Take the readings of a frame."""
        ...

    def reset(self) -> None:
        """Forget all."""
        ...


class ToolFollower(Protocol):
    """Follows tools from frame to frame; see compute/pose/tool_tracker.py."""

    def step(
        self,
        time_ns: int,
        sequence: int,
        position_px: Array,
        sigma_px: Array,
        peak_flags: NDArray[np.int32],
        marker: int | None,
        points: PointBatch | None,
    ) -> tuple[ToolPose, ...]:
        """Take the readings of a frame; return a pose of each tool, in order."""
        ...

    def reset(self) -> None:
        """Forget all."""
        ...


class MakeFollowers(Protocol):
    """Makes them of a calibration; a test puts its own in their place."""

    def markers(self, active: ActiveCalibration, tracked: Tracked) -> MarkerFollower:
        """Return what follows markers."""
        ...

    def tools(
        self,
        active: ActiveCalibration,
        tracked: Tracked,
        tools: Sequence[RigidBody],
        before: ToolFollower | None,
    ) -> ToolFollower:
        """Return what follows these tools; raises LumilineError when one cannot be followed.

        It goes on with what ``before``, of the same calibration, knows of the same tools.
        """
        ...


class OwnFollowers:
    """Those of compute; loaded when a device first needs them."""

    def markers(self, active: ActiveCalibration, tracked: Tracked) -> MarkerFollower:
        """Return what follows markers."""
        from compute.tracking.methods import marker_tracker
        from compute.tracking.settings import TrackerSettings

        covariance, table = uncertainty(active)
        models = active.calibration.models
        return marker_tracker(
            CameraStack.of(models),
            TrackerSettings() if tracked.tracker is None else tracked.tracker,
            covariance,
            table,
            tuple(model.pixels for model in models),
        )

    def tools(
        self,
        active: ActiveCalibration,
        tracked: Tracked,
        tools: Sequence[RigidBody],
        before: ToolFollower | None,
    ) -> ToolFollower:
        """Return what follows these tools; raises LumilineError when one cannot be followed."""
        from compute.pose.settings import ToolTrackerSettings
        from compute.pose.tool_tracker import ToolTracker

        covariance, table = uncertainty(active)
        models = active.calibration.models
        made = ToolTracker(
            CameraStack.of(models),
            tools,
            ToolTrackerSettings() if tracked.tool_tracker is None else tracked.tool_tracker,
            covariance,
            table,
            tuple(model.pixels for model in models),
        )
        if isinstance(before, ToolTracker):
            made.keep(before)
        return made


def uncertainty(active: ActiveCalibration) -> "tuple[Array | None, CorrectionTable | None]":
    """Return the parameters' covariance and the table that go with a calibration.

    A table's variance is that of the whole reading, the calibration's share included: with one
    there is no covariance beside it.
    """
    if active.table is not None:
        return None, active.table
    return np.array(active.calibration.covariance), None
