"""TrackingStage: tracks and tool poses, frame by frame; faults of a tracker stay with its tools."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.errors import LumilineError
from compute.measurement.measurements import Measurements
from compute.pose.rigid_body import PoseStatus, RigidBody, ToolPose
from compute.reconstruction.point_batch import PointBatch
from compute.tracking.blink_identification import BlinkIdentifier
from compute.tracking.track_batch import TrackBatch
from hardware.line_frame import LineFrame
from service.pipeline.active_calibration import PreparedCalibration
from service.pipeline.tracking_config import NO_TRACKING, TrackingConfig

if TYPE_CHECKING:
    from compute.pose.tool_tracking.tool_tracker import ToolTracker
    from compute.tracking.tracker import Tracker

_log = logging.getLogger(__name__)

NO_CALIBRATION: Final = "the device has no active calibration"
FRAME_SKIPPED: Final = "the computer does not keep up with the device: frames are passed over"
NO_DETECTION_METHOD: Final = "nothing is known to read the lines of this device"
MIN_BACKOFF_S: Final = 0.5
"""After which a tool whose tracking failed is tracked anew, and twice as long each time after."""
MAX_BACKOFF_S: Final = 30.0
"""Of these: a tool that always fails costs next to nothing, and a line of the log now and then."""


class TrackerFactory:
    """Makes the trackers of compute, which load when a device first needs them."""

    def markers(self, active: PreparedCalibration, tracked: TrackingConfig) -> "Tracker":
        """Return the marker tracker."""
        from compute.tracking.settings import TrackerSettings
        from compute.tracking.tracker import Tracker

        models = active.calibration.models
        return Tracker(
            CameraStack.of(models),
            tracked.tracker or TrackerSettings(),
            active.covariance,
            active.table,
            tuple(model.pixels for model in models),
        )

    def tools(
        self,
        active: PreparedCalibration,
        tracked: TrackingConfig,
        tools: Sequence[RigidBody],
        before: "ToolTracker | None",
    ) -> "ToolTracker":
        """Return the tracker of these tools.

        It adopts the state that ``before``, of the same calibration, has of the same tools.

        Raises:
            LumilineError: one of them cannot be tracked.
        """
        from compute.pose.settings import ToolTrackerSettings
        from compute.pose.tool_tracking.tool_tracker import ToolTracker

        models = active.calibration.models
        tracker = ToolTracker(
            CameraStack.of(models),
            tools,
            tracked.tool_tracker or ToolTrackerSettings(),
            active.covariance,
            active.table,
            tuple(model.pixels for model in models),
        )
        if before is not None:
            tracker.adopt_state(before)
        return tracker


@dataclass(eq=False)
class _Group:
    """Tools that are tracked together; a fault in one of them is a fault of its group.

    Args:
        tools: the tools.
        tracker: their tracker; None: there is none.
        reason: why there is none.
        faults: of its trackers so far.
        failed_ns: when it failed, on the device's clock [ns]; None: it never began.
    """

    tools: Sequence[RigidBody]
    tracker: "ToolTracker | None"
    reason: str = ""
    faults: int = 0
    failed_ns: int | None = None

    def may_restart(self, now_ns: int) -> bool:
        """Whether what failed is to be tried again: after twice the time of the time before."""
        if self.tracker is not None or self.failed_ns is None:
            return False
        wait_s = min(MIN_BACKOFF_S * 2.0 ** (self.faults - 1), MAX_BACKOFF_S)
        # A device's clock that went back starts the time anew.
        return not 0 <= now_ns - self.failed_ns < 1e9 * wait_s


class _DeviceClock:
    """Notices that a device's clock went back: it was restarted, and what is tracked is stale."""

    def __init__(self) -> None:
        self._last_ns: int | None = None

    def went_back(self, frame: LineFrame) -> bool:
        """Whether a frame was not exposed after the one before."""
        last, self._last_ns = self._last_ns, frame.exposure_device_ns
        return last is not None and frame.exposure_device_ns <= last


class TrackingStage:
    """Tracks markers and tools through the frames of one device; lives where frames are
    processed.

    No fault of a tracker stops the device: tools that cannot be tracked have the status INVALID
    and the reason. When tracking all tools together fails, each is tracked by itself from then on,
    so that the faulty one does not take the others with it; one that fails by itself is restarted
    after a while, more and more rarely. The marker tracker is restarted at most MAX_RESTARTS
    times.

    Args:
        device_id: the device, for the log.
        sensors: how many it has.
        reads: whether a method reads its scans.
        make: makes the trackers.
    """

    MAX_RESTARTS: Final = 3

    def __init__(
        self, device_id: str, sensors: int, *, reads: bool, make: TrackerFactory | None = None
    ) -> None:
        self._device_id = device_id
        self.no_tracks = TrackBatch.empty(sensors)
        """The tracks of a frame in which nothing is tracked."""
        self._reads = reads
        self._make = make or TrackerFactory()
        self._tracked = NO_TRACKING
        self._active: PreparedCalibration | None = None
        self._markers: Tracker | None = None
        self._names: BlinkIdentifier | None = None
        self._groups: list[_Group] = []
        self._restarts = 0
        self._tools_clock, self._markers_clock = _DeviceClock(), _DeviceClock()
        self._first_number = 0  # added to the markers' numbers, which are never used again
        self._highest_number = 0

    def set_tracking_config(self, tracked: TrackingConfig) -> None:
        """Replace the configuration from the next frame on; existing tracks go on."""
        before, self._tracked = self._tracked, tracked
        active = self._active
        if active is None:
            return
        blinking = tracked.blinking != before.blinking
        if not tracked.tracks:
            self._markers = None
        elif self._markers is None or tracked.tracker != before.tracker or blinking:
            self._restarts = 0
            self._markers = self._marker_tracker(active)
        tracker = self._groups[0].tracker if len(self._groups) == 1 else None
        same = tracked.tool_tracker == before.tool_tracker
        self._groups = self._tool_groups(active, tracked.tools, tracker if same else None)

    def set_calibration(self, active: PreparedCalibration | None) -> None:
        """Track with another calibration; tracks and tools are acquired anew."""
        self._active = active if self._reads else None
        self._markers, self._groups = None, []
        tracked, self._tracked = self._tracked, NO_TRACKING
        self.set_tracking_config(tracked)

    def pose_limits(self) -> tuple[Sequence[RigidBody], float]:
        """Return the tools, and the limit of the tip's standard deviation of those without [mm]."""
        from compute.pose.settings import ToolTrackerSettings

        settings = self._tracked.tool_tracker or ToolTrackerSettings()
        return self._tracked.tools, settings.max_tip_sd_mm

    def find_poses(
        self,
        frames: Sequence[LineFrame],
        measurements: Measurements | None,
        points: PointBatch,
        owner: NDArray[np.intp],
        track: Sequence[bool] | None = None,
    ) -> list[Sequence[ToolPose]]:
        """Return the tool poses of each frame of a batch.

        Args:
            frames: F frames, in their order.
            measurements: of these, shape (F, S, K); None: there is no calibration, or no method
                reads the scans.
            points: of those frames in which all markers are lit; of others they are not used.
            owner: index of the frame of each.
            track: of each frame, whether anything is tracked in it; None: in all. In others tools
                are MISSING, as the computer does not keep up.
        """
        poses: list[Sequence[ToolPose]] = []
        starts = owner.searchsorted(range(len(frames) + 1)).tolist()
        unavailable = NO_CALIBRATION if self._reads else NO_DETECTION_METHOD
        tools = self._tracked.tools
        for index, frame in enumerate(frames):
            if measurements is None:
                poses.append(_without(tools, frame, PoseStatus.UNKNOWN, unavailable))
                continue
            if self._tools_clock.went_back(frame):
                for group in self._groups:
                    if group.tracker is not None:
                        group.tracker.reset()
            if track is not None and not track[index]:
                poses.append(_without(tools, frame, PoseStatus.MISSING, FRAME_SKIPPED))
                continue
            lit = frame.marker is None
            frame_points = points.part(starts[index], starts[index + 1]) if lit else None
            poses.append(self._track_tools(frame, measurements.exposure(index), frame_points))
        return poses

    def find_tracks(
        self,
        frames: Sequence[LineFrame],
        measurements: Measurements | None,
        track: Sequence[bool] | None = None,
    ) -> list[TrackBatch]:
        """Return the tracks after each frame of a batch; arguments as of ``find_poses``.

        There are none in frames that are not tracked.
        """
        if self._markers is None or measurements is None:
            return [self.no_tracks] * len(frames)
        tracks: list[TrackBatch] = []
        for index, frame in enumerate(frames):
            if self._markers_clock.went_back(frame) and self._markers is not None:
                self._markers.reset()
            tracked = track is None or track[index]
            found = self._track_markers(frame, measurements.exposure(index)) if tracked else None
            tracks.append(found or self.no_tracks)
        return tracks

    def _marker_tracker(self, active: PreparedCalibration) -> "Tracker | None":
        """Return a marker tracker; its track numbers go on where those before ended."""
        self._first_number = self._highest_number
        blinking = self._tracked.blinking
        self._names = None if blinking is None else BlinkIdentifier(*blinking)
        try:
            return self._make.markers(active, self._tracked)
        except Exception:  # noqa: BLE001 - logged
            self._log("its markers cannot be tracked")
            return None

    def _tool_groups(
        self,
        active: PreparedCalibration,
        tools: Sequence[RigidBody],
        before: "ToolTracker | None",
    ) -> list[_Group]:
        """Return all tools in one group; where that cannot be, each in its own."""
        if not tools:
            return []
        try:
            return [_Group(tools, self._make.tools(active, self._tracked, tools, before))]
        except Exception:  # noqa: BLE001 - logged
            self._log("its tools cannot be tracked together; each is by itself")
            return [self._single_tool_group(active, tool) for tool in tools]

    def _single_tool_group(
        self, active: PreparedCalibration, tool: RigidBody, faults: int = 0
    ) -> _Group:
        try:
            tracker = self._make.tools(active, self._tracked, [tool], None)
            return _Group([tool], tracker, faults=faults)
        except Exception as error:  # noqa: BLE001 - becomes the tool's status
            self._log(f"its tool {tool.name} cannot be tracked")
            return _Group([tool], None, f"the tool cannot be tracked: {_error_message(error)}")

    def _track_markers(self, frame: LineFrame, measurements: Measurements) -> TrackBatch | None:
        if self._markers is None:
            return None
        # The device's clock: the host's has the jitter of the way to it.
        time_ns = frame.exposure_device_ns
        try:
            tracks = self._markers.step(time_ns, measurements, frame.marker)
            if self._names is not None:
                lit = frame.marker is None
                tracks = self._names.name(frame.sequence, tracks, measurements.amplitude, lit=lit)
        except Exception:  # noqa: BLE001 - logged
            self._restarts += 1
            again = self._restarts <= self.MAX_RESTARTS
            self._log(f"tracking its markers failed and {'begins anew' if again else 'has ended'}")
            assert self._active is not None
            self._markers = self._marker_tracker(self._active) if again else None
            return None
        if not len(tracks):
            return None
        if self._first_number:
            tracks = replace(tracks, identity=tracks.identity + self._first_number)
        self._highest_number = max(self._highest_number, int(tracks.identity.max()))
        return tracks

    def _track_tools(
        self,
        frame: LineFrame,
        measurements: Measurements,
        points: PointBatch | None,
    ) -> tuple[ToolPose, ...]:
        poses: list[ToolPose] = []
        groups: list[_Group] = []
        for group in self._groups:
            if group.may_restart(frame.exposure_device_ns):
                assert self._active is not None
                group = self._single_tool_group(self._active, group.tools[0], group.faults)
            if group.tracker is None:
                poses += _without(group.tools, frame, PoseStatus.INVALID, group.reason)
                groups.append(group)
                continue
            try:
                poses += group.tracker.step(
                    frame.exposure_device_ns,
                    frame.sequence,
                    measurements,
                    frame.marker,
                    points,
                    frame.exposure_host_ns,
                )
                groups.append(group)
            except Exception as error:  # noqa: BLE001 - becomes the tools' status
                reason = f"its tracking failed: {_error_message(error)}"
                poses += _without(group.tools, frame, PoseStatus.INVALID, reason)
                groups += self._failed(group, reason, frame.exposure_device_ns)
        self._groups = groups
        return tuple(poses)

    def _failed(self, group: _Group, reason: str, now_ns: int) -> list[_Group]:
        """Return what to do after a fault: each tool by itself; one that was so, after a while."""
        self._log(f"tracking of {', '.join(tool.name for tool in group.tools)} failed")
        assert self._active is not None
        if len(group.tools) > 1:
            return [self._single_tool_group(self._active, tool) for tool in group.tools]
        return [_Group(group.tools, None, reason, group.faults + 1, now_ns)]

    def _log(self, what: str) -> None:
        device = {"device": self._device_id}
        _log.exception("device %s: %s", self._device_id, what, extra=device)


def _without(
    tools: Sequence[RigidBody], frame: LineFrame, status: PoseStatus, reason: str
) -> list[ToolPose]:
    return [
        ToolPose(tool.name, status, reason, frame.exposure_host_ns, frame.sequence)
        for tool in tools
    ]


def _error_message(error: Exception) -> str:
    return error.detail if isinstance(error, LumilineError) else type(error).__name__
