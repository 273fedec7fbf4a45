"""Frames that show a patient: a tool's pose, strobed markers, or markers lit together."""

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from compute.pose.beam_hold import BeamHoldLimits, BeamHoldTiming
from compute.pose.rigid_body import PoseStatus, ToolPose
from compute.reconstruction.point_batch import PointBatch
from compute.signal.peaks import PeakBatch
from compute.tracking.track_batch import TrackBatch
from compute.transform import Transform
from hardware.line_frame import LineFrame
from service.pipeline.frame_batch import FrameBatch, TrackingResult
from service.pipeline.tracking_config import (
    BeamHoldConfig,
    HoldReference,
    Spec,
    WatchedLitMarkers,
    WatchedStrobedMarkers,
    WatchedTool,
)

Array = NDArray[np.float64]
MS = 1_000_000
WALL_NS = 1_700_000_000 * 10**9
"""The host's clock when the device's is at 0."""
HOME = np.array([[0.0, 0.0, 1500.0], [90.0, 0.0, 1500.0], [0.0, 50.0, 1500.0]])
NAMES = ("a", "b", "c", "d")
SIGMA_MM = 0.02


def frame(time_ns: int, marker: int | None = None) -> LineFrame:
    return LineFrame(
        "sim", time_ns // MS, time_ns, WALL_NS + time_ns, marker, np.zeros((4, 8), np.uint16)
    )


def batch(
    frames: Sequence[LineFrame],
    places: Sequence[Array],
    poses: Sequence[Sequence[ToolPose]] = (),
    tracks: Sequence[TrackBatch] = (),
    calibration: str | None = "cal",
    table: str | None = None,
) -> FrameBatch:
    """Frames with the points that each shows, shape (N, 3)."""
    points = np.vstack([np.empty((0, 3)), *places])
    size = len(points)
    motion = None
    if poses or tracks:
        none = [TrackBatch.empty(4)] * len(frames)
        motion = TrackingResult.of(tracks or none, poses or [()] * len(frames))
    return FrameBatch(
        "sim", NAMES, calibration, table, tuple(frames), PeakBatch.empty(4 * len(frames), 1),
        PointBatch(
            points, np.broadcast_to(SIGMA_MM**2 * np.eye(3), (size, 3, 3)).copy(), np.ones(size),
            np.full(size, np.inf), np.ones((size, 4), np.bool_), np.zeros(size, np.int32),
        ),
        np.repeat(np.arange(len(frames)), [len(one) for one in places]),
        motion,
    )  # fmt: skip


def tool_frame(
    time_ns: int,
    shift_mm: float = 0.0,
    status: PoseStatus = PoseStatus.OK,
    unseen_ns: int = 0,
    calibration: str | None = "cal",
    table: str | None = None,
) -> FrameBatch:
    """One frame with the pose of tool "head", shifted along X."""
    pose = ToolPose(
        "head", status, None if status is PoseStatus.OK else "it is hidden", WALL_NS + time_ns,
        time_ns // MS,
    )  # fmt: skip
    if status is PoseStatus.OK:
        pose = replace(
            pose, rotation=np.eye(3), translation_mm=np.array([shift_mm, 0.0, 1500.0]),
            covariance=np.diag([1e-8] * 3 + [SIGMA_MM**2] * 3), unseen_ns=unseen_ns,
        )  # fmt: skip
    return batch([frame(time_ns)], [np.empty((0, 3))], [(pose,)], (), calibration, table)


def strobed_frame(time_ns: int, marker: int, place_mm: Array | None) -> FrameBatch:
    """One frame of a strobed marker; None: it is not seen."""
    seen = np.empty((0, 3)) if place_mm is None else place_mm[None]
    return batch([frame(time_ns, marker)], [seen])


def lit_frame(time_ns: int, positions_mm: Array) -> FrameBatch:
    """One frame with points of markers that are lit together."""
    return batch([frame(time_ns)], [positions_mm])


RULES = BeamHoldTiming(max_gap_ns=50 * MS, settle_ns=100 * MS)
HEAD = WatchedTool("head")
CHEST = WatchedStrobedMarkers((4, 5, 6), 3)
LIT = WatchedLitMarkers(3, 3, 20.0)


def reference(
    spec: Spec, identity: str = "first", calibration: str | None = "cal"
) -> HoldReference:
    at = datetime.fromtimestamp(WALL_NS * 1e-9 + 1.0, UTC)
    if isinstance(spec, WatchedTool):
        pose = Transform(np.eye(3), np.array([0.0, 0.0, 1500.0]))
        return HoldReference(identity, at, calibration, None, pose)
    return HoldReference(identity, at, calibration, None, None, HOME)


def hold(
    spec: Spec = HEAD,
    rules: BeamHoldTiming = RULES,
    *,
    identity: str = "watch",
    shift_mm: float = 1.0,
    referred: HoldReference | None = None,
    referenced: bool = True,
) -> BeamHoldConfig:
    """A hold of device ``sim`` that allows a shift."""
    where = (referred or reference(spec)) if referenced else None
    key = f"{spec} {rules} {shift_mm} {where and where.id}"
    limits = BeamHoldLimits(shift_mm=shift_mm, rules=rules)
    return BeamHoldConfig(identity, "sim", key, spec, limits, where)
