"""Tracks and tool poses as the stream sends them."""

from collections.abc import Iterator
from functools import lru_cache
from itertools import pairwise
from math import isfinite
from typing import Any

from compute.flags import flag_names
from compute.tracking.track_batch import TrackFlag, TrackState
from service.pipeline.pose_message import pose_message
from service.pipeline.tracking_result import TrackingResult


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


@lru_cache
def _track_flags(flags: int) -> tuple[str, ...]:
    return flag_names(TrackFlag(flags))


_STATES = {int(state): state.name.lower() for state in TrackState}
