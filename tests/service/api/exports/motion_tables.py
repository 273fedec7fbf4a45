"""Motion tables for tests, of frames some of which were lost, with gaps in everything."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from compute.pose.rigid_body import PoseStatus
from compute.tracking.track_batch import TrackState
from service.api.exports.motion_table import MotionTable, PointRows, PoseRows, TrackRows

STATUSES = [status.value for status in PoseStatus]
WITH_POSE = ("OK", "HIGH_ERROR", "OUT_OF_VOLUME")


def table(
    seed: int = 1, frames: int = 40, tools: tuple[str, ...] = ("probe", "ref")
) -> MotionTable:
    """A table with numbers of full precision, and irregular times."""
    rng = np.random.default_rng(seed)
    sequence = 1000 + np.cumsum(rng.integers(1, 3, frames))
    device_ns = sequence * 10_000_000 + rng.integers(0, 100_000, frames)
    shown = np.sort(rng.choice(frames, frames // 2, replace=False))
    points = PointRows(
        shown,
        rng.normal(0.0, 300.0, (len(shown), 3)),
        rng.uniform(0.0, 0.3, (len(shown), 3)),
        np.full(len(shown), np.nan),
        rng.integers(0, 2, len(shown)).astype(np.int32),
    )
    points.position_mm[0] = np.nan
    state: list[int] = []
    rows: list[tuple[int, int, int]] = []
    for frame in range(frames):
        for identity, marker in ((3, 0), (4, 1), (7, -1), (9, 1), (11, -1)):
            if rng.random() < 0.8:
                rows.append((frame, identity, marker))
                tentative = identity == 11 or frame < 3
                seen = TrackState.CONFIRMED if rng.random() < 0.7 else TrackState.COASTING
                state.append(TrackState.TENTATIVE if tentative else seen)
    columns: Any = np.array(rows)
    count = len(rows)
    tracks = TrackRows(
        columns[:, 0],
        columns[:, 1],
        columns[:, 2].astype(np.int32),
        np.array(state, np.int8),
        rng.integers(0, 32, count).astype(np.int32),
        rng.normal(0.0, 300.0, (count, 3)),
        rng.uniform(0.0, 3.5, (count, 3)),
        rng.normal(0.0, 1000.0, (count, 3)),
    )
    return MotionTable(
        "bar",
        100.0,
        sequence,
        device_ns,
        device_ns + 1_700_000_000_000_000_000,
        np.where(np.arange(frames) % 3 == 0, 2, -1).astype(np.int32),
        points,
        tracks,
        tools,
        _poses(rng, frames, len(tools)),
        {"calibration": "cal-1"},
    )


def _poses(rng: np.random.Generator, frames: int, tools: int) -> PoseRows:
    count = frames * tools
    status = np.array(rng.choice(STATUSES, count), np.str_).reshape(-1)
    poses = PoseRows(
        np.repeat(np.arange(frames), tools),
        np.tile(np.arange(tools), frames),
        status,
        Rotation.random(count, random_state=3).as_matrix() if count else np.empty((0, 3, 3)),
        rng.normal(0.0, 500.0, (count, 3)),
        rng.uniform(0.0, 0.2, (count, 3)),
        rng.normal(0.0, 500.0, (count, 3)),
        rng.uniform(0.0, 0.4, (count, 3)),
        rng.uniform(0.5, 1.5, count),
    )
    without = ~np.isin(status, WITH_POSE)
    for one in (poses.rotation, poses.translation_mm, poses.sd_mm, poses.tip_mm, poses.tip_sd_mm):
        one[without] = np.nan
    poses.residual_sigma[without] = np.nan
    return poses
