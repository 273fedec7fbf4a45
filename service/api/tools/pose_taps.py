"""Taps of a running device that take the poses of a tool: PoseTap and TipTap."""

from collections import deque
from collections.abc import Iterator
from typing import Final

from compute.pose.rigid_body import PoseStatus, ToolPose
from service.api.tools.frame_conversion import pose_in_frame
from service.pipeline.frame_batch import FrameBatch
from service.pipeline.taps import SingleCalibrationTap


class _ToolTap(SingleCalibrationTap):
    """Base of taps of a tool's poses.

    Args:
        tool: its id.
        reference: the tool that they are wanted relative to; None: the tracker.
    """

    def __init__(self, tool: str, reference: str | None) -> None:
        super().__init__()
        self._tool = tool
        self._reference = reference

    def _pairs(self, batch: FrameBatch) -> Iterator[tuple[ToolPose, ToolPose | None]]:
        """Yield the tool's poses of a batch, each with its reference's where that has one."""
        if not self._goes_on(batch) or batch.motion is None:
            return
        for frame in range(len(batch.frames)):
            poses = {pose.tool: pose for pose in batch.motion.poses_of(frame)}
            if self._tool in poses:
                yield poses[self._tool], poses.get(self._reference or "")


class PoseTap(_ToolTap):
    """Collects at most ``max_poses`` valid poses of a tool while one calibration is active."""

    def __init__(self, tool: str, reference: str | None, max_poses: int) -> None:
        super().__init__(tool, reference)
        self.poses: list[ToolPose] = []
        self.statuses: dict[PoseStatus, int] = {}
        """Frames by the status of the tool, or of what it is relative to."""
        self.reason: str | None = None
        """Why the newest pose that was not taken was not."""
        self._max_poses = max_poses

    def offer(self, batch: FrameBatch) -> None:
        """Collect from a batch; called where frames are processed."""
        for pose, reference in self._pairs(batch):
            if self._reference is not None:
                if reference is None:
                    continue
                pose = pose_in_frame(pose, reference)
            self.statuses[pose.status] = self.statuses.get(pose.status, 0) + 1
            if not pose.valid:
                self.reason = pose.reason
                continue
            self.poses.append(pose)
            if len(self.poses) >= self._max_poses:
                self.ended.set()
                return


MAX_KEPT: Final = 20_000
"""Frames that wait to be drained; the oldest go first."""

Pair = tuple[ToolPose, ToolPose | None]


class TipTap(_ToolTap):
    """Keeps the poses of a tool frame by frame while one calibration is active."""

    def __init__(self, tool: str, reference: str | None) -> None:
        super().__init__(tool, reference)
        # Its append and popleft are atomic: one thread puts in, another takes out.
        self._kept: deque[Pair] = deque(maxlen=MAX_KEPT)

    def offer(self, batch: FrameBatch) -> None:
        """Collect from a batch; called where frames are processed."""
        for pose, reference in self._pairs(batch):
            if reference is None and self._reference is not None:
                reference = ToolPose(
                    self._reference,
                    PoseStatus.UNKNOWN,
                    "the device does not track it yet",
                    pose.exposure_ns,
                    pose.sequence,
                )
            self._kept.append((pose, reference))

    def drained(self) -> Iterator[Pair]:
        """Yield the poses that were not yet yielded, oldest first, each with the reference's."""
        while self._kept:
            yield self._kept.popleft()
