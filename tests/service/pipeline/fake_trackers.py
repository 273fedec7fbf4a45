"""Plain stand-ins for the trackers: they say what they were given, and fail on request."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compute.errors import DegenerateTool
from compute.measurement.measurements import Measurements
from compute.pose.rigid_body import PoseStatus, RigidBody, ToolPose
from compute.reconstruction.point_batch import PointBatch
from compute.tracking.track_batch import TrackBatch, TrackState
from service.pipeline.active_calibration import PreparedCalibration
from service.pipeline.tracking_config import TrackingConfig

Array = NDArray[np.float64]


def some_tracks(count: int, sensors: int = 4, first: int = 1) -> TrackBatch:
    """Tracks with numbers from ``first``, each at its number along X."""
    identity = np.arange(first, first + count)
    position = np.zeros((count, 3))
    position[:, 0] = identity
    return replace(
        TrackBatch.empty(sensors),
        identity=identity,
        marker=np.full(count, -1, np.int32),
        state=np.full(count, int(TrackState.CONFIRMED), np.int8),
        flags=np.zeros(count, np.int32),
        position_mm=position,
        velocity_mm_s=np.zeros((count, 3)),
        acceleration_mm_s2=np.full((count, 3), np.nan),
        covariance=np.broadcast_to(np.eye(9), (count, 9, 9)).copy(),
        peaks=np.full((count, sensors), -1, np.int32),
        nis=np.full(count, np.nan),
        dof=np.zeros(count, np.int32),
    )


@dataclass(eq=False)
class Markers:
    """One track for each peak of the first sensor."""

    fails_at: int | None = None
    steps: list[tuple[Any, ...]] = field(default_factory=list)
    resets: int = 0

    def step(
        self,
        time_ns: int,
        measurements: Measurements,
        marker: int | None,
    ) -> TrackBatch:
        self.steps.append((time_ns, marker))
        if self.fails_at is not None and len(self.steps) > self.fails_at:
            raise ZeroDivisionError("of the markers")
        return some_tracks(int(measurements.count[0]), len(measurements))

    def reset(self) -> None:
        self.resets += 1


@dataclass(eq=False)
class Tools:
    """All tools at the origin, OK; a tool called "late" makes the third step fail."""

    tools: Sequence[RigidBody]
    steps: list[tuple[Any, ...]] = field(default_factory=list)
    resets: int = 0

    def step(
        self,
        time_ns: int,
        sequence: int,
        measurements: Measurements,
        marker: int | None,
        points: PointBatch | None,
        exposure_ns: int,
    ) -> tuple[ToolPose, ...]:
        self.steps.append((time_ns, sequence, marker, None if points is None else len(points)))
        if len(self.steps) > 2 and any(tool.name == "late" for tool in self.tools):
            raise ZeroDivisionError("of the tools")
        return tuple(
            ToolPose(
                tool.name,
                PoseStatus.OK,
                None,
                exposure_ns,
                sequence,
                np.eye(3),
                np.zeros(3),
                np.eye(6),
            )
            for tool in self.tools
        )

    def reset(self) -> None:
        self.resets += 1


@dataclass(eq=False)
class Making:
    """Makes stand-ins; refuses to make a tool called "wrong"."""

    fails_at: int | None = None
    made_markers: list[Markers] = field(default_factory=list)
    made_tools: list[Tools] = field(default_factory=list)
    before: list[Any] = field(default_factory=list)

    def markers(self, active: PreparedCalibration, tracked: TrackingConfig) -> Markers:
        self.made_markers.append(Markers(self.fails_at))
        return self.made_markers[-1]

    def tools(
        self,
        active: PreparedCalibration,
        tracked: TrackingConfig,
        tools: Sequence[RigidBody],
        before: Any,
    ) -> Tools:
        if any(tool.name == "wrong" for tool in tools):
            raise DegenerateTool("its markers are on a line")
        self.before.append(before)
        self.made_tools.append(Tools(tools))
        return self.made_tools[-1]
