"""Motion: what moved in a batch of frames, as tracks of markers and poses of tools."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
from numpy.typing import NDArray

from compute.pose.tool_pose import ToolPose
from compute.tracking.track_batch import TrackBatch


@dataclass(frozen=True, eq=False)
class TrackingResult:
    """Tracks and tool poses of the F frames of a batch.

    Args:
        tracks: tracks after each frame, frame by frame.
        track_owner: index of the frame of each of them, ascending, shape (T,).
        poses: poses of tools, frame by frame.
        pose_owner: index of the frame of each of them, ascending, shape (P,).
    """

    tracks: TrackBatch
    track_owner: NDArray[np.intp]
    poses: tuple[ToolPose, ...]
    pose_owner: NDArray[np.intp]

    @classmethod
    def of(
        cls, tracks: Sequence[TrackBatch], poses: Sequence[Sequence[ToolPose]], sensors: int
    ) -> Self:
        """Join what was found in F frames, one after the other.

        Args:
            tracks: of each frame, F of them.
            poses: of each frame, F lists of any length.
            sensors: how many the device has.
        """
        joined = TrackBatch.empty(sensors)
        if any(map(len, tracks)):
            columns = (field.name for field in fields(TrackBatch))
            joined = TrackBatch(
                *(np.concatenate([getattr(one, name) for one in tracks]) for name in columns)
            )
        return cls(
            joined,
            np.repeat(np.arange(len(tracks)), [len(one) for one in tracks]),
            tuple(pose for found in poses for pose in found),
            np.repeat(np.arange(len(poses)), [len(found) for found in poses]),
        )

    def poses_of(self, frame: int) -> tuple[ToolPose, ...]:
        """Return the poses of the frame with this index."""
        first, last = self.pose_owner.searchsorted((frame, frame + 1)).tolist()
        return self.poses[first:last]
