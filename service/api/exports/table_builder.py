"""TableBuilder: a motion table from the pipeline's batches of frames."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compute.pose.rigid_body import ToolPose
from service.api.exports.motion_table import NO_MARKER, MotionTable, PointRows, PoseRows, TrackRows
from service.pipeline.frame_batch import FrameBatch

Array = NDArray[np.float64]


class TableBuilder:
    """Collects batches of one device.

    Args:
        device: its name.
        rate_hz: frames per second; 0: not known, then it follows from their times.
        tools: names of the tools that poses are of.
    """

    def __init__(self, device: str, rate_hz: float, tools: Sequence[str]) -> None:
        self._device = device
        self._rate_hz = rate_hz
        self._tools = {name: index for index, name in enumerate(tools)}
        self._frames: list[tuple[int, int, int, int]] = []
        self._points: list[tuple[Any, ...]] = []
        self._tracks: list[tuple[Any, ...]] = []
        self._poses: list[tuple[Any, ...]] = []

    def __len__(self) -> int:
        """Return the number of frames so far."""
        return len(self._frames)

    def add(self, batch: FrameBatch) -> None:
        """Append the frames of a batch, and what was found in them."""
        first = len(self)
        for frame in batch.frames:
            self.add_frame(
                frame.sequence, frame.exposure_device_ns, frame.exposure_host_ns, frame.marker
            )
        points = batch.points
        if len(points):
            self.add_points(
                first + batch.owner,
                points.position_mm,
                points.covariance_mm2,
                points.residual_sigma(),
                points.flags,
            )
        motion = batch.motion
        if motion is None:
            return
        tracks = motion.tracks
        if len(tracks):
            self.add_tracks(
                first + motion.track_owner,
                tracks.identity,
                tracks.marker,
                tracks.state,
                tracks.flags,
                tracks.position_mm,
                tracks.covariance[:, :3, :3],
                tracks.velocity_mm_s,
            )
        for owner, pose in zip(motion.pose_owner.tolist(), motion.poses, strict=True):
            self.add_pose(first + owner, pose)

    def add_frame(self, sequence: int, device_ns: int, host_ns: int, marker: int | None) -> None:
        """Append a frame."""
        number = NO_MARKER if marker is None else marker
        self._frames.append((sequence, device_ns, host_ns, number))

    def add_points(
        self,
        frame: NDArray[np.intp],
        position_mm: Array,
        covariance_mm2: Array,
        residual_sigma: Array,
        flags: NDArray[np.int32],
    ) -> None:
        """Append points of the newest frames: N of each."""
        self._points.append(
            (frame, position_mm, standard_deviations(covariance_mm2), residual_sigma, flags)
        )

    def add_tracks(
        self,
        frame: NDArray[np.intp],
        identity: NDArray[np.int64],
        marker: NDArray[np.int32],
        state: NDArray[np.int8],
        flags: NDArray[np.int32],
        position_mm: Array,
        covariance_mm2: Array,
        velocity_mm_s: Array,
    ) -> None:
        """Append states of tracks at the newest frames: N of each."""
        sd = standard_deviations(covariance_mm2)
        self._tracks.append((frame, identity, marker, state, flags, position_mm, sd, velocity_mm_s))

    def add_pose(self, frame: int, pose: ToolPose) -> None:
        """Append a pose of one of the newest frames."""
        covariance = pose.covariance
        row = (
            frame,
            self._tools.setdefault(pose.tool, len(self._tools)),
            pose.status.value,
            _or_nan(pose.rotation, (3, 3)),
            _or_nan(pose.translation_mm, (3,)),
            standard_deviations(
                _or_nan(None if covariance is None else covariance[3:, 3:], (3, 3))
            ),
            _or_nan(pose.tip_mm, (3,)),
            standard_deviations(_or_nan(pose.tip_covariance_mm2, (3, 3))),
            np.nan if pose.residual_sigma is None else pose.residual_sigma,
        )
        self._poses.append(row)

    def build(self, notes: Mapping[str, str] | None = None) -> MotionTable:
        """Return the table of all that was added."""
        frames = np.array(self._frames, np.int64).reshape(-1, 4)
        sequence, device_ns, host_ns, marker = frames.T
        rate = self._rate_hz or measured_rate(sequence, device_ns)
        return MotionTable(
            self._device,
            rate,
            sequence,
            device_ns,
            host_ns,
            marker.astype(np.int32),
            PointRows(*_joined(self._points, ((), (3,), (3,), (), ()), "pdddi")),
            TrackRows(*_joined(self._tracks, ((), (), (), (), (), (3,), (3,), (3,)), "pliciddd")),
            tuple(self._tools),
            PoseRows(
                *_stacked(
                    self._poses, ((), (), (), (3, 3), (3,), (3,), (3,), (3,), ()), "ppUdddddd"
                )
            ),
            dict(notes or {}),
        )


def standard_deviations(covariance: Array) -> Array:
    """Return the roots of the diagonals of covariances (..., 3, 3), shape (..., 3)."""
    found: Array = np.sqrt(np.einsum("...ii->...i", covariance).clip(min=0.0))
    return found


def measured_rate(sequence: NDArray[np.int64], device_ns: NDArray[np.int64]) -> float:
    """Return the frame rate [Hz] by sequence numbers and times; 0: too few frames."""
    if len(sequence) < 2 or device_ns[-1] <= device_ns[0]:
        return 0.0
    return float((sequence[-1] - sequence[0]) / ((device_ns[-1] - device_ns[0]) * 1e-9))


_TYPES: dict[str, Any] = {
    "p": np.intp, "l": np.int64, "i": np.int32, "c": np.int8, "d": np.float64, "U": np.str_,
}  # fmt: skip


def _joined(
    parts: list[tuple[Any, ...]], shapes: tuple[tuple[int, ...], ...], kinds: str
) -> list[Any]:
    """Return columns of parts that are arrays, in one piece each."""
    empty = [np.empty((0, *shape), _TYPES[kind]) for shape, kind in zip(shapes, kinds, strict=True)]
    return [
        np.concatenate([none, *(part[index] for part in parts)]).astype(none.dtype)
        for index, none in enumerate(empty)
    ]


def _stacked(
    rows: list[tuple[Any, ...]], shapes: tuple[tuple[int, ...], ...], kinds: str
) -> list[Any]:
    """Return columns of rows."""
    return [
        np.array([row[index] for row in rows], _TYPES[kind]).reshape(-1, *shape)
        for index, (shape, kind) in enumerate(zip(shapes, kinds, strict=True))
    ]


def _or_nan(values: Array | None, shape: tuple[int, ...]) -> Array:
    return np.full(shape, np.nan) if values is None else values
