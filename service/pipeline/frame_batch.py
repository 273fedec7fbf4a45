"""FrameBatch: results of a batch of frames; LatestPoses: the newest poses of all devices."""

import asyncio
import math
import time
from collections.abc import Callable, Mapping, Sequence, Sized
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from math import isfinite
from threading import Lock
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from compute.flags import flag_names
from compute.pose.beam_hold import BeamHoldCause
from compute.pose.rigid_body import ToolPose
from compute.reconstruction.point_batch import PointBatch
from compute.signal.peaks import PeakBatch
from compute.tracking.track_batch import TrackBatch, TrackFlag, TrackState
from compute.transform import rotation_quaternion
from hardware.line_frame import LineFrame
from service.pipeline.threads import call_in_loop

Array = NDArray[np.float64]
Vector = tuple[float, float, float]
_TRACK_STATES: Final = {int(state): state.name.lower() for state in TrackState}


class BeamEnableToken:
    """Validity of "the beam is enabled": shared by all states that say so, ended by the next hold.

    Once it is over, whatever said that the beam may go on says so no more, however long it waits
    until it is sent. Ended by whoever holds the beam, and by itself at its deadline.

    Args:
        monotonic_s: a clock that does not go back [s].
    """

    __slots__ = ("_monotonic_s", "due_s", "ended")

    def __init__(self, monotonic_s: Callable[[], float]) -> None:
        self._monotonic_s = monotonic_s
        self.ended: BeamHoldState | None = None
        """The state that ended it; None: none did, though its deadline may have passed."""
        self.due_s = -math.inf
        """When its newest measurement is too old, by that clock [s]."""

    @property
    def over(self) -> bool:
        """Whether the beam was held since, or the deadline has passed."""
        return self.ended is not None or self._monotonic_s() >= self.due_s


@dataclass(frozen=True, slots=True)
class BeamHoldState:
    """State of a beam hold after a frame, or after an event between two frames.

    Args:
        hold_id: the hold.
        held: whether the beam is held.
        cause: why.
        reason: the same for a person; None while it is not held.
        since_ns: when it began to be, or not to be, held, on the host's clock [ns].
        exposure_ns: middle of the exposure of the newest frame that was looked at, on the host's
            clock [ns]; None: none was yet.
        sequence: number of that frame.
        shift_mm: of the target, or of the marker that is nearest to its limit [mm]; None: not
            measured in this frame.
        rotation_rad: rotation vector from the reference [rad]; None: not measured, or of markers.
        probability: of being beyond the limit that is nearest to it.
        release: while it is not held: what says whether that is still so.
        revision: grows with each state of any hold in this process.
    """

    hold_id: str
    held: bool
    cause: BeamHoldCause
    reason: str | None
    since_ns: int
    exposure_ns: int | None = None
    sequence: int | None = None
    shift_mm: Vector | None = None
    rotation_rad: Vector | None = None
    probability: float | None = None
    release: BeamEnableToken | None = field(default=None, compare=False, repr=False)
    revision: int = field(default=0, compare=False, repr=False)

    def held_because(self, why: str) -> "BeamHoldState":
        """Return the state held, for want of data."""
        return replace(self, held=True, cause=BeamHoldCause.NO_DATA, reason=why, release=None)

    @property
    def superseded(self) -> bool:
        """Whether it says "enabled", and the beam was held since."""
        return not self.held and self.release is not None and self.release.over

    @property
    def standing(self) -> "BeamHoldState":
        """The state as it is to be reported now: held, where the beam was held since."""
        if not self.superseded:
            return self
        assert self.release is not None
        by = self.release.ended
        if by is None:
            return self.held_because("nothing was measured since for longer than is allowed")
        return replace(
            self, held=True, cause=by.cause, reason=by.reason, since_ns=by.since_ns, release=None
        )


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
    def of(cls, tracks: Sequence[TrackBatch], poses: Sequence[Sequence[ToolPose]]) -> Self:
        """Concatenate the tracks and poses of F frames.

        Args:
            tracks: of each frame, F of them, at least one.
            poses: of each frame, F lists of any length.
        """
        return cls(
            TrackBatch.concatenate(tracks),
            _owners(tracks),
            tuple([pose for found in poses for pose in found]),
            _owners(poses),
        )

    def poses_of(self, frame: int) -> tuple[ToolPose, ...]:
        """Return the poses of the frame with this index."""
        first, last = self.pose_owner.searchsorted((frame, frame + 1)).tolist()
        return self.poses[first:last]


def _owners(parts: Sequence[Sized]) -> NDArray[np.intp]:
    """Return the index of the part that each item belongs to."""
    if len(parts) == 1:
        return np.zeros(len(parts[0]), dtype=np.intp)
    return np.repeat(np.arange(len(parts)), [len(part) for part in parts])


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
        radiometric_id: the radiometric calibration of these peaks; None: they had none.
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
    radiometric_id: str | None = None

    def points_of(self, frame: int) -> PointBatch:
        """Return the points of the frame with this index."""
        return self.points.part(*self.owner.searchsorted((frame, frame + 1)).tolist())


def pose_members(pose: ToolPose) -> dict[str, Any]:
    """Return a pose as JSON values: the members of ToolPose, and its rotation as a quaternion."""
    return {
        "tool_id": pose.tool,
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
        "residual_sigma": _value(pose.residual_sigma),
        "markers_used": pose.markers_used,
        "readings_used": pose.readings_used,
        "velocity_mm_s": _values(pose.velocity_mm_s),
        "angular_velocity_rad_s": _values(pose.angular_velocity_rad_s),
        "detectable_sigma": _value(pose.detectable_sigma),
        "external_tip_mm": _value(pose.external_tip_mm),
        "external_rotation_rad": _value(pose.external_rotation_rad),
    }


def track_members(tracks: TrackBatch, part: slice) -> list[dict[str, Any]]:
    """Return tracks of a batch as JSON values."""
    columns = (
        tracks.identity,
        tracks.marker,
        tracks.state,
        tracks.flags,
        tracks.position_mm,
        tracks.covariance[:, :3, :3],
        tracks.velocity_mm_s,
        tracks.covariance[:, 3:6, 3:6],
        tracks.acceleration_mm_s2,
        tracks.peaks,
        tracks.nis,
        tracks.dof,
    )
    # Straight from the arrays: objects in between cost too much at thousands of frames.
    return [
        {
            "id": identity,
            "marker": None if marker < 0 else marker,
            "state": _TRACK_STATES[state],
            "flags": _track_flag_names(flags),
            "position_mm": position,
            "covariance_mm2": covariance if isfinite(covariance[0][0]) else None,
            "velocity_mm_s": velocity,
            "velocity_covariance_mm2_s2": (
                velocity_covariance if isfinite(velocity_covariance[0][0]) else None
            ),
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
        ) in zip(*(column[part].tolist() for column in columns), strict=True)
    ]


@lru_cache(maxsize=1024)
def _track_flag_names(flags: int) -> tuple[str, ...]:
    return flag_names(TrackFlag(flags))


def _value(number: float | None) -> float | None:
    """Return a number; None for infinity and NaN, which JSON does not have."""
    return number if number is not None and isfinite(number) else None


def _values(array: Array | None) -> list[Any] | None:
    """Return an array as lists; None for NaN, for which JSON has no number."""
    if array is None or not np.isfinite(array).all():
        return None
    values: list[Any] = array.tolist()
    return values


@dataclass(frozen=True, eq=False)
class PoseEntry:
    """All poses of one device at one instant.

    Args:
        device_id: the device.
        sequence: number of the frame.
        exposure_ns: middle of its exposure on the host's clock [ns].
        poses: of all tools of the device, by name; those that are not seen too.
        calibration_id: the active calibration.
        frame_rate_hz: frames of the device per second; 0 when not known.
        table_id: the active correction table; None: none.
        arrived_s: when it was made, as time.monotonic() counts [s]: the wall clock may be set.
    """

    device_id: str
    sequence: int
    exposure_ns: int
    poses: Mapping[str, ToolPose]
    calibration_id: str | None
    frame_rate_hz: float = 0.0
    table_id: str | None = None
    arrived_s: float = field(default_factory=time.monotonic)


def newest_poses(batch: FrameBatch, motion: TrackingResult, frame_rate_hz: float) -> PoseEntry:
    """Return the poses of the newest frame of a batch.

    Args:
        batch: F frames of a device, F > 0.
        motion: of the batch.
        frame_rate_hz: of the device; 0 when not known.
    """
    newest = batch.frames[-1]
    return PoseEntry(
        batch.device_id,
        newest.sequence,
        newest.exposure_host_ns,
        {pose.tool: pose for pose in motion.poses_of(len(batch.frames) - 1)},
        batch.calibration_id,
        frame_rate_hz,
        batch.table_id,
    )


class LatestPoses:
    """Newest poses of all devices; who processes frames writes, and waits for no reader."""

    def __init__(self) -> None:
        """Begin without any entry."""
        self._lock = Lock()
        self._newest: dict[str, PoseEntry] = {}
        self._listeners: list[Callable[[PoseEntry], None]] = []

    def put(self, entry: PoseEntry) -> None:
        """Replace the entry of a device, and call the listeners."""
        with self._lock:
            self._newest[entry.device_id] = entry
        for listener in tuple(self._listeners):
            listener(entry)

    def newest(self) -> dict[str, PoseEntry]:
        """Return the newest entry of every device that has tools."""
        with self._lock:
            return dict(self._newest)

    def remove(self, device_id: str) -> None:
        """Remove the entry of a device: it has stopped, or has no tools any more."""
        with self._lock:
            self._newest.pop(device_id, None)

    def call_at_once(self, call: Callable[[PoseEntry], None]) -> Callable[[], None]:
        """Call with every newer entry, in the thread that puts it.

        Returns:
            What ends it; may be called again.
        """
        self._listeners.append(call)

        def end() -> None:
            with suppress(ValueError):
                self._listeners.remove(call)

        return end

    def listen(self, call: Callable[[PoseEntry], None]) -> Callable[[], None]:
        """Call in the running event loop with every newer entry.

        Returns:
            What ends it; may be called again.
        """
        return self.call_at_once(partial(call_in_loop, asyncio.get_running_loop(), call))
