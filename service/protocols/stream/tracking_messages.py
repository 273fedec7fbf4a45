"""Tracks and tool poses as the stream sends them."""

from collections.abc import Iterator
from functools import lru_cache
from itertools import pairwise
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compute.camera.rotation import rotation_quaternion
from compute.flags import flag_names
from compute.pose.tool_pose import ToolPose
from compute.tracking.track_batch import TrackFlag, TrackState
from service.pipeline.tracking_result import TrackingResult

Array = NDArray[np.float64]


def track_messages(
    motion: TrackingResult | None, first: int, count: int
) -> Iterator[list[dict[str, Any]]]:
    """Yield the tracks of each of ``count`` frames from ``first`` on; none without motion."""
    if motion is None:
        yield from ([] for _ in range(count))
        return
    starts = motion.track_owner.searchsorted(range(first, first + count + 1)).tolist()
    own = slice(starts[0], starts[-1])
    tracks = motion.tracks
    rows = [
        {
            "id": identity,
            "marker": None if marker < 0 else marker,
            "state": _STATES[state],
            "flags": _track_flags(flags),
            "position_mm": position,
            "covariance_mm2": covariance,
            "velocity_mm_s": velocity,
            "velocity_covariance_mm2_s2": velocity_covariance,
            "acceleration_mm_s2": acceleration if isfinite(acceleration[0]) else None,
            "peaks": [None if peak < 0 else peak for peak in peaks],
            "nis": nis if isfinite(nis) else None,
            "dof": dof,
        }
        for (
            identity,
            marker,
            state,
            flags,
            position,
            covariance,
            velocity,
            velocity_covariance,
            acceleration,
            peaks,
            nis,
            dof,
        ) in zip(
            tracks.identity[own].tolist(),
            tracks.marker[own].tolist(),
            tracks.state[own].tolist(),
            tracks.flags[own].tolist(),
            tracks.position_mm[own].tolist(),
            tracks.covariance[own, :3, :3].tolist(),
            tracks.velocity_mm_s[own].tolist(),
            tracks.covariance[own, 3:6, 3:6].tolist(),
            tracks.acceleration_mm_s2[own].tolist(),
            tracks.peaks[own].tolist(),
            tracks.nis[own].tolist(),
            tracks.dof[own].tolist(),
            strict=True,
        )
    ]
    for begin, end in pairwise(starts):
        yield rows[begin - starts[0] : end - starts[0]]


def tool_pose_messages(
    motion: TrackingResult | None, first: int, count: int
) -> Iterator[list[dict[str, Any]]]:
    """Yield the tool poses of each of ``count`` frames from ``first`` on; none without motion."""
    for frame in range(first, first + count):
        yield [] if motion is None else [pose_message(pose) for pose in motion.poses_of(frame)]


def pose_message(pose: ToolPose) -> dict[str, Any]:
    """Return a pose with the members of ToolPose, and its turn as a quaternion, too."""
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


@lru_cache
def _track_flags(flags: int) -> tuple[str, ...]:
    return flag_names(TrackFlag(flags))


_STATES = {int(state): state.name.lower() for state in TrackState}
