"""Batches of frames with the poses of tools, as the live side makes them."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from compute.pose.rigid_body import PoseStatus, ToolPose
from compute.reconstruction.point_batch import PointBatch
from compute.signal.peaks import PeakBatch
from compute.tracking.track_batch import TrackBatch
from compute.transform import rotation_matrix
from hardware.line_frame import LineFrame
from service.pipeline.frame_batch import FrameBatch, TrackingResult

Array = NDArray[np.float64]
NAMES = ("vertical", "horizontal", "diagonal-rising", "diagonal-falling")
TIP_MM = (-150.0, 0.0, 0.0)
PIVOT_MM = np.array([20.0, -30.0, 1500.0])
SIGMA_RAD, SIGMA_MM = 2e-4, 0.02
COVARIANCE = np.diag([SIGMA_RAD**2] * 3 + [SIGMA_MM**2] * 3)


def pose(
    tool: str,
    sequence: int,
    rotation: Array,
    translation_mm: Array,
    status: PoseStatus = PoseStatus.OK,
    reason: str | None = None,
    exposure_ns: int | None = None,
) -> ToolPose:
    at = sequence * 1_000_000 if exposure_ns is None else exposure_ns
    tip = np.array(TIP_MM)
    return ToolPose(
        tool, status, reason, at, sequence, rotation, translation_mm, COVARIANCE,
        rotation @ tip + translation_mm, np.eye(3) * 1e-3, 1.0, 4, 16,
    )  # fmt: skip


def noisy(rotation: Array, translation_mm: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    turned = rotation_matrix(rng.normal(0.0, SIGMA_RAD, 3)) @ rotation
    return turned, translation_mm + rng.normal(0.0, SIGMA_MM, 3)


def pivoting(tool: str, count: int, swing_rad: float = 0.6) -> list[ToolPose]:
    """A tool that is turned in all directions about its tip, which stays."""
    rng = np.random.default_rng(5)
    found = []
    for number in range(count):
        rotation = rotation_matrix(rng.uniform(-swing_rad, swing_rad, 3))
        moved = noisy(rotation, PIVOT_MM - rotation @ np.array(TIP_MM), rng)
        found.append(pose(tool, number, *moved))
    return found


def resting(
    tool: str, count: int, first: int = 0, at_mm: Array = PIVOT_MM, seed: int = 9
) -> list[ToolPose]:
    """A tool at rest, its tip at a place, in a thousand frames a second from one on."""
    rng = np.random.default_rng(seed)
    rotation = rotation_matrix(np.array([0.3, -0.4, 0.5]))
    centre = at_mm - rotation @ np.array(TIP_MM)
    return [pose(tool, first + n, *noisy(rotation, centre, rng)) for n in range(count)]


def spinning(tool: str, count: int) -> list[ToolPose]:
    """A tool that is turned about its Z axis, through (5, 0, 0)."""
    rng = np.random.default_rng(6)
    point = np.array([5.0, 0.0, 0.0])
    found = []
    for number in range(count):
        rotation = rotation_matrix(np.array([0.0, 0.0, 2.0 * np.pi * number / count]))
        found.append(pose(tool, number, *noisy(rotation, PIVOT_MM - rotation @ point, rng)))
    return found


def tool_batch(
    poses: Sequence[Sequence[ToolPose]],
    points: Mapping[int, Array] | None = None,
    calibration: str | None = "sim-nominal",
    device: str = "sim",
) -> FrameBatch:
    """Frames with one list of poses each, every tool's in its own list.

    With ``points`` each frame shows one of these strobed markers, in turn.
    """
    frames = max(map(len, poses)) if poses else 0
    by_frame = [[one[frame] for one in poses if frame < len(one)] for frame in range(frames)]
    markers = sorted(points or {})
    lines = np.zeros((4, 8), np.uint16)
    exposures = tuple(
        LineFrame(
            device,
            n,
            n * 1_000_000,
            n * 1_000_000,
            markers[n % len(markers)] if markers else None,
            lines,
        )
        for n in range(frames)
    )
    places = np.empty((0, 3))
    if points:
        rng = np.random.default_rng(7)
        places = np.array([points[markers[n % len(markers)]] for n in range(frames)])
        places = places + rng.normal(0.0, SIGMA_MM, places.shape)
    size = len(places)
    batch = PointBatch(
        places,
        np.broadcast_to(SIGMA_MM**2 * np.eye(3), (size, 3, 3)).copy(),
        np.ones(size),
        np.full(size, np.inf),
        np.ones((size, 4), dtype=np.bool_),
        np.zeros(size, np.int32),
    )
    owner = np.arange(size, dtype=np.intp)
    none = [TrackBatch.empty(4)] * frames
    return FrameBatch(
        device, NAMES, calibration, None, exposures, PeakBatch.empty(4 * frames, 1), batch, owner,
        TrackingResult.of(none, by_frame),
    )  # fmt: skip
