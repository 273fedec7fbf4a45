"""PoseTap: takes the poses of a tool from a running device's batches."""

from typing import TYPE_CHECKING

from service.api.tools.frame_conversion import pose_in_frame
from service.pipeline.frame_batch import FrameBatch
from service.pipeline.single_calibration_tap import SingleCalibrationTap

if TYPE_CHECKING:
    from compute.pose.tool_pose import PoseStatus, ToolPose


class PoseTap(SingleCalibrationTap):
    """Collects the poses of a tool that are OK, with one calibration in force all the time.

    Args:
        tool: its id.
        reference: the tool that they are taken relative to; None: the tracker.
        most: how many are collected at most.
    """

    def __init__(self, tool: str, reference: str | None, max_poses: int) -> None:
        super().__init__()
        self.poses: list[ToolPose] = []
        self.statuses: dict[PoseStatus, int] = {}
        """Frames by the status of the tool, or of what it is relative to."""
        self.reason: str | None = None
        """Why the newest pose that was not taken was not."""
        self._tool = tool
        self._reference = reference
        self._max_poses = max_poses

    def offer(self, batch: FrameBatch) -> None:
        """Take what is wanted of a batch; called in the compute thread."""
        if not self._goes_on(batch) or batch.motion is None:
            return
        for frame in range(len(batch.frames)):
            poses = {pose.tool: pose for pose in batch.motion.poses_of(frame)}
            pose = poses.get(self._tool)
            if pose is None:
                continue
            if self._reference is not None:
                reference = poses.get(self._reference)
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
