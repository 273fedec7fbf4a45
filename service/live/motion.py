"""Motion: what moved in a batch of frames, as tracks of markers and poses of tools."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.pose.tool_pose import ToolPose
from compute.tracking.track_batch import TrackBatch


@dataclass(frozen=True, eq=False)
class Motion:
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
