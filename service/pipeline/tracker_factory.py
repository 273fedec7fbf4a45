"""Followers: the trackers of markers and of tools, as the live path makes and calls them."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.pose.rigid_body import RigidBody
from compute.pose.tool_pose import ToolPose
from compute.reconstruction.point_batch import PointBatch
from compute.tracking.track_batch import TrackBatch
from service.pipeline.point_stage import CalibrationSolver
from service.pipeline.tracking_config import TrackingConfig

if TYPE_CHECKING:
    from compute.mapping.table import CorrectionTable

Array = NDArray[np.float64]


class MarkerTrackerProtocol(Protocol):
    """Follows markers from frame to frame; see compute/tracking/factory.py."""

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


class ToolTrackerProtocol(Protocol):
    """Follows tools from frame to frame; see compute/pose/tool_tracking/tool_tracker.py."""

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


class TrackerFactory(Protocol):
    """Makes them of a calibration; a test puts its own in their place."""

    def markers(self, active: CalibrationSolver, tracked: TrackingConfig) -> MarkerTrackerProtocol:
        """Return what follows markers."""
        ...

    def tools(
        self,
        active: CalibrationSolver,
        tracked: TrackingConfig,
        tools: Sequence[RigidBody],
        before: ToolTrackerProtocol | None,
    ) -> ToolTrackerProtocol:
        """Return what follows these tools; raises LumilineError when one cannot be followed.

        It goes on with what ``before``, of the same calibration, knows of the same tools.
        """
        ...


class DefaultTrackerFactory:
    """Those of compute; loaded when a device first needs them."""

    def markers(self, active: CalibrationSolver, tracked: TrackingConfig) -> MarkerTrackerProtocol:
        """Return what follows markers."""
        from compute.tracking.factory import create_tracker
        from compute.tracking.settings import TrackerSettings

        covariance, table = calibration_covariance(active)
        models = active.calibration.models
        return create_tracker(
            CameraStack.of(models),
            TrackerSettings() if tracked.tracker is None else tracked.tracker,
            covariance,
            table,
            tuple(model.pixels for model in models),
        )

    def tools(
        self,
        active: CalibrationSolver,
        tracked: TrackingConfig,
        tools: Sequence[RigidBody],
        before: ToolTrackerProtocol | None,
    ) -> ToolTrackerProtocol:
        """Return what follows these tools; raises LumilineError when one cannot be followed."""
        from compute.pose.settings import ToolTrackerSettings
        from compute.pose.tool_tracking.tool_tracker import ToolTracker

        covariance, table = calibration_covariance(active)
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
            made.adopt_state(before)
        return made


def calibration_covariance(
    active: CalibrationSolver,
) -> "tuple[Array | None, CorrectionTable | None]":
    """Return the parameters' covariance and the table that go with a calibration.

    A table's variance is that of the whole reading, the calibration's share included: with one
    there is no covariance beside it.
    """
    if active.table is not None:
        return None, active.table
    return np.array(active.calibration.covariance), None
