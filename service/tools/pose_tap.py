"""PoseTap: takes the poses of a tool from a running device's batches."""

from threading import Event
from typing import TYPE_CHECKING

from service.live.batch import FrameBatch
from service.live.in_force import InForce
from service.tools.frames import in_frame

if TYPE_CHECKING:
    from compute.pose.tool_pose import PoseStatus, ToolPose


class PoseTap:
    """Collects the poses of a tool that are OK, with one calibration in force all the time.

    Args:
        tool: its id.
        reference: the tool that they are taken relative to; None: the tracker.
        most: how many are collected at most.
    """

    def __init__(self, tool: str, reference: str | None, most: int) -> None:
        self.poses: list[ToolPose] = []
        self.statuses: dict[PoseStatus, int] = {}
        """Frames by the status of the tool, or of what it is relative to."""
        self.reason: str | None = None
        """Why the newest pose that was not taken was not."""
        self.ended = Event()
        """Set when there are enough, or another calibration or table came into force."""
        self.switched = False
        self.in_force: tuple[str | None, str | None] | None = None
        self._tool = tool
        self._reference = reference
        self._most = most

    def prepare(self, found: InForce) -> None:
        """Do nothing: the batches say what they were made with."""

    def offer(self, batch: FrameBatch) -> None:
        """Take what is wanted of a batch; called in the compute thread."""
        own = (batch.calibration_id, batch.table_id)
        if self.in_force is None:
            self.in_force = own
        if own != self.in_force:
            self.switched = True
            self.ended.set()
        if batch.motion is None or self.ended.is_set():
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
                pose = in_frame(pose, reference)
            self.statuses[pose.status] = self.statuses.get(pose.status, 0) + 1
            if not pose.valid:
                self.reason = pose.reason
                continue
            self.poses.append(pose)
            if len(self.poses) >= self._most:
                self.ended.set()
                return
