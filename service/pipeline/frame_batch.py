"""FrameBatch: what the stages make of a batch of frames; TrackingResult: its tracks and poses."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from math import isfinite
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from compute.camera.rotation import rotation_quaternion
from compute.pose.rigid_body import ToolPose
from compute.reconstruction.point_batch import PointBatch
from compute.signal.peaks import PeakBatch
from compute.tracking.track_batch import TrackBatch
from hardware.line_frame import LineFrame
from service.pipeline.beam_hold_state import BeamHoldState

Array = NDArray[np.float64]


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
        """Concatenate the tracks and poses of F frames.

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


@dataclass(frozen=True, eq=False)
class FrameBatch:
    """Frames of one device, processed together.

    Args:
        device_id: the device.
        sensor_names: its sensors in order.
        calibration_id: the calibration of these points; None: there are no points.
        table_id: the correction table of these points; None: readings were not corrected.
        frames: F frames in the order of their exposure.
        peaks: peaks of the F x S lines, frame by frame.
        points: N points of all frames.
        owner: index of the frame of each point, ascending, shape (N,).
        motion: tracks and tool poses; None: the device is not tracked.
        holds: the device's beam holds after each frame; empty: it has none.
    """

    device_id: str
    sensor_names: tuple[str, ...]
    calibration_id: str | None
    table_id: str | None
    frames: tuple[LineFrame, ...]
    peaks: PeakBatch
    points: PointBatch
    owner: NDArray[np.intp]
    motion: TrackingResult | None = None
    holds: tuple[tuple[BeamHoldState, ...], ...] = ()


def pose_members(pose: ToolPose) -> dict[str, Any]:
    """Return a pose as JSON values: the members of ToolPose, and its rotation as a quaternion."""
    sigma = pose.residual_sigma
    return {
        "tool": pose.tool,
        "status": pose.status.value,
        "reason": pose.reason,
        "translation_mm": _values(pose.translation_mm),
        "rotation": _values(pose.rotation),
        "quaternion_wxyz": _values(
            None if pose.rotation is None else rotation_quaternion(pose.rotation)
        ),
        "covariance": _values(pose.covariance),
        "tip_mm": _values(pose.tip_mm),
        "tip_covariance_mm2": _values(pose.tip_covariance_mm2),
        "residual_sigma": sigma if sigma is not None and isfinite(sigma) else None,
        "markers_used": pose.markers_used,
        "readings_used": pose.readings_used,
        "velocity_mm_s": _values(pose.velocity_mm_s),
        "angular_velocity_rad_s": _values(pose.angular_velocity_rad_s),
    }


def _values(array: Array | None) -> list[Any] | None:
    """Return an array as lists; None for what is not known, for which JSON has no number."""
    if array is None or not np.isfinite(array).all():
        return None
    found: list[Any] = array.tolist()
    return found
