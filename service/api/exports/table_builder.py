"""TableBuilder: a motion table from the pipeline's batches of frames."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from compute.pose.rigid_body import ToolPose
from service.api.exports.motion_table import (
    NO_MARKER,
    NO_POINTS,
    NO_TRACKS,
    MotionTable,
    PointRows,
    PoseRows,
    TrackRows,
    stack_or_nan,
    standard_deviations,
)
from service.pipeline.frame_batch import FrameBatch


class TableBuilder:
    """Collects batches of one device.

    Args:
        device: its name.
        rate_hz: frames per second; 0: not known, then it follows from their times.
        tools: names of the tools that poses are of.

    Attributes:
        points: of the frames that were added.
        tracks: states of tracks at these frames.
        poses: poses of tools, each with the index of its frame.
    """

    def __init__(self, device: str, rate_hz: float, tools: Sequence[str]) -> None:
        self._device = device
        self._rate_hz = rate_hz
        self._tools = tools
        self._frames: list[tuple[int, int, int, int]] = []
        self.points = [NO_POINTS]
        self.tracks = [NO_TRACKS]
        self.poses: list[tuple[int, ToolPose]] = []

    def __len__(self) -> int:
        """Return the number of frames so far."""
        return len(self._frames)

    def add(self, batch: FrameBatch) -> None:
        """Append the frames of a batch, with their points, tracks and poses."""
        first = len(self)
        for frame in batch.frames:
            self.add_frame(
                frame.sequence, frame.exposure_device_ns, frame.exposure_host_ns, frame.marker
            )
        points, motion = batch.points, batch.motion
        if len(points):
            sigma_mm = standard_deviations(points.covariance_mm2)
            frames = first + batch.owner
            self.points.append(
                PointRows(
                    frames, points.position_mm, sigma_mm, points.residual_sigma(), points.flags
                )
            )
        if motion is None:
            return
        tracks = motion.tracks
        if len(tracks):
            sigma_mm = standard_deviations(tracks.covariance[:, :3, :3])
            self.tracks.append(
                TrackRows(
                    first + motion.track_owner, tracks.identity, tracks.marker, tracks.state,
                    tracks.flags, tracks.position_mm, sigma_mm, tracks.velocity_mm_s,
                )
            )  # fmt: skip
        owners = (first + motion.pose_owner).tolist()
        self.poses += zip(owners, motion.poses, strict=True)

    def add_frame(self, sequence: int, device_ns: int, host_ns: int, marker: int | None) -> None:
        """Append a frame."""
        number = NO_MARKER if marker is None else marker
        self._frames.append((sequence, device_ns, host_ns, number))

    def build(self, notes: Mapping[str, str] | None = None) -> MotionTable:
        """Return the table of all that was added."""
        frames = np.array(self._frames, np.int64).reshape(-1, 4)
        sequence, device_ns, host_ns, marker = frames.T
        tools = tuple(dict.fromkeys([*self._tools, *(pose.tool for _, pose in self.poses)]))
        return MotionTable(
            self._device,
            self._rate_hz or measured_rate(sequence, device_ns),
            sequence,
            device_ns,
            host_ns,
            marker.astype(np.int32),
            PointRows.concatenate(self.points),
            TrackRows.concatenate(self.tracks),
            tools,
            _pose_rows(self.poses, tools),
            dict(notes or {}),
        )


def measured_rate(sequence: NDArray[np.int64], device_ns: NDArray[np.int64]) -> float:
    """Return the frame rate [Hz] by sequence numbers and times; 0: too few frames."""
    if len(sequence) < 2 or device_ns[-1] <= device_ns[0]:
        return 0.0
    return float((sequence[-1] - sequence[0]) / ((device_ns[-1] - device_ns[0]) * 1e-9))


def _pose_rows(poses: Sequence[tuple[int, ToolPose]], tools: Sequence[str]) -> PoseRows:
    index = {name: number for number, name in enumerate(tools)}
    listed = [pose for _, pose in poses]
    translation = [None if one.covariance is None else one.covariance[3:, 3:] for one in listed]
    tip = [pose.tip_covariance_mm2 for pose in listed]
    return PoseRows(
        np.array([frame for frame, _ in poses], np.intp),
        np.array([index[pose.tool] for pose in listed], np.intp),
        np.array([pose.status.value for pose in listed], np.str_),
        stack_or_nan((pose.rotation for pose in listed), (3, 3)),
        stack_or_nan((pose.translation_mm for pose in listed), (3,)),
        standard_deviations(stack_or_nan(translation, (3, 3))),
        stack_or_nan((pose.tip_mm for pose in listed), (3,)),
        standard_deviations(stack_or_nan(tip, (3, 3))),
        stack_or_nan(pose.residual_sigma for pose in listed),
    )
