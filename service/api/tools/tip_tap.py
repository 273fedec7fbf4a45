"""TipTap: takes the poses of a tool and of its reference from a running device, as they come."""

from collections import deque
from collections.abc import Iterator
from typing import Final

from compute.pose.tool_pose import PoseStatus, ToolPose
from service.pipeline.frame_batch import FrameBatch
from service.pipeline.single_calibration_tap import SingleCalibrationTap

MAX_KEPT: Final = 20_000
"""Frames that wait to be drained; the oldest go first."""

Pair = tuple[ToolPose, ToolPose | None]


class TipTap(SingleCalibrationTap):
    """Keeps the poses of a tool frame by frame, with one calibration in force all the time.

    Args:
        tool: its id.
        reference: the tool that it is wanted relative to; None: the tracker.
    """

    def __init__(self, tool: str, reference: str | None) -> None:
        super().__init__()
        self._tool = tool
        self._reference = reference
        # Its append and popleft are atomic: one thread puts in, another takes out.
        self._kept: deque[Pair] = deque(maxlen=MAX_KEPT)

    def offer(self, batch: FrameBatch) -> None:
        """Take what is wanted of a batch; called in the compute thread."""
        if not self._goes_on(batch) or batch.motion is None:
            return
        for frame in range(len(batch.frames)):
            poses = {pose.tool: pose for pose in batch.motion.poses_of(frame)}
            pose = poses.get(self._tool)
            if pose is None:
                continue
            reference = None
            if self._reference is not None:
                reference = poses.get(self._reference) or ToolPose(
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
