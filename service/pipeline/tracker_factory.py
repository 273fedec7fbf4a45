"""TrackerFactory: makes the trackers of markers and of tools that the tracking stage calls."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.measurement.measurements import Measurements
from compute.pose.rigid_body import RigidBody, ToolPose
from compute.reconstruction.point_batch import PointBatch
from compute.tracking.track_batch import TrackBatch
from service.pipeline.active_calibration import PreparedCalibration
from service.pipeline.tracking_config import TrackingConfig

Array = NDArray[np.float64]


class MarkerTrackerProtocol(Protocol):
    """Tracks markers from frame to frame; see compute/tracking/tracker.py."""

    def step(
        self,
        time_ns: int,
        measurements: Measurements,
        marker: int | None,
    ) -> TrackBatch:
        """Process the readings of a frame; return the tracks after it."""
        ...

    def reset(self) -> None:
        """Forget all tracks."""
        ...


class ToolTrackerProtocol(Protocol):
    """Tracks tools from frame to frame; see compute/pose/tool_tracking/tool_tracker.py."""

    def step(
        self,
        time_ns: int,
        sequence: int,
        measurements: Measurements,
        marker: int | None,
        points: PointBatch | None,
    ) -> tuple[ToolPose, ...]:
        """Process the readings of a frame; return a pose of each tool, in order."""
        ...

    def reset(self) -> None:
        """Forget all tracks."""
        ...


class TrackerFactory(Protocol):
    """Makes the trackers for a calibration; tests put their own in place."""

    def markers(
        self, active: PreparedCalibration, tracked: TrackingConfig
    ) -> MarkerTrackerProtocol:
        """Return the marker tracker."""
        ...

    def tools(
        self,
        active: PreparedCalibration,
        tracked: TrackingConfig,
        tools: Sequence[RigidBody],
        before: ToolTrackerProtocol | None,
    ) -> ToolTrackerProtocol:
        """Return the tracker of these tools; raises LumilineError when one cannot be tracked.

        It adopts the state that ``before``, of the same calibration, has of the same tools.
        """
        ...


class DefaultTrackerFactory:
    """Makes the trackers of compute, which load when a device first needs them."""

    def markers(
        self, active: PreparedCalibration, tracked: TrackingConfig
    ) -> MarkerTrackerProtocol:
        """Return the marker tracker."""
        from compute.tracking.settings import TrackerSettings
        from compute.tracking.tracker import Tracker

        models = active.calibration.models
        return Tracker(
            CameraStack.of(models),
            TrackerSettings() if tracked.tracker is None else tracked.tracker,
            active.covariance,
            active.table,
            tuple(model.pixels for model in models),
        )

    def tools(
        self,
        active: PreparedCalibration,
        tracked: TrackingConfig,
        tools: Sequence[RigidBody],
        before: ToolTrackerProtocol | None,
    ) -> ToolTrackerProtocol:
        """Return the tracker of these tools; raises LumilineError when one cannot be tracked."""
        from compute.pose.settings import ToolTrackerSettings
        from compute.pose.tool_tracking.tool_tracker import ToolTracker

        models = active.calibration.models
        made = ToolTracker(
            CameraStack.of(models),
            tools,
            ToolTrackerSettings() if tracked.tool_tracker is None else tracked.tool_tracker,
            active.covariance,
            active.table,
            tuple(model.pixels for model in models),
        )
        if isinstance(before, ToolTracker):
            made.adopt_state(before)
        return made
