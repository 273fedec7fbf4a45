"""StreamBatch: frames of one device as the streams keep them, and their members as plain values."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from math import isfinite
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from compute.flags import flag_names
from compute.reconstruction.point_batch import PointBatch, PointFlag
from compute.signal.peaks import PeakBatch, PeakFlag
from compute.tracking.track_batch import TrackFlag, TrackState
from hardware.line_frame import FrameFlag
from service.pipeline.beam_hold_state import BeamEnableToken, BeamHoldState
from service.pipeline.frame_batch import FrameBatch, TrackingResult, pose_members

Rows = list[dict[str, Any]]
"""The points, peaks, tracks, ... of one frame, as a message has them."""


class FrameHeader(NamedTuple):
    """A frame without its pixels; see LineFrame."""

    sequence: int
    exposure_device_ns: int
    exposure_host_ns: int
    marker: int | None
    flags: FrameFlag


@dataclass(frozen=True, eq=False)
class FlatPeaks:
    """The P peaks of the lines of some frames, line after line, without the empty places.

    Args:
        start: index of the first peak of each line, and P at the end, shape (L + 1,).
        values: position [px], sigma [px], amplitude [counts], width [px] and reduced chi-square
            of each, shape (5, P).
        flags: PeakFlag values, shape (P,).
    """

    start: NDArray[np.intp]
    values: NDArray[np.float64]
    flags: NDArray[np.int32]

    @classmethod
    def of(cls, peaks: PeakBatch) -> Self:
        """Return the peaks of a batch, copied."""
        start = np.zeros(len(peaks.count) + 1, dtype=np.intp)
        np.cumsum(peaks.count, out=start[1:])
        there = np.arange(peaks.position_px.shape[1]) < peaks.count[:, None]
        values = np.stack(
            [
                column[there]
                for column in (
                    peaks.position_px,
                    peaks.sigma_px,
                    peaks.amplitude,
                    peaks.width_px,
                    peaks.reduced_chi2,
                )
            ]
        )
        return cls(start, values.astype(np.float64, copy=False), peaks.flags[there])


@dataclass(frozen=True, eq=False)
class StreamBatch:
    """Frames of one device as the streams keep them; the members are those of FrameBatch.

    Args:
        releases: of all holds that say that a beam is not held, each once.
    """

    device_id: str
    sensor_names: tuple[str, ...]
    calibration_id: str | None
    table_id: str | None
    frames: tuple[FrameHeader, ...]
    peaks: FlatPeaks
    points: PointBatch
    owner: NDArray[np.intp]
    motion: TrackingResult | None = None
    holds: tuple[tuple[BeamHoldState, ...], ...] = ()
    releases: tuple[BeamEnableToken, ...] = ()

    @classmethod
    def of(cls, batch: FrameBatch) -> Self:
        """Return what is kept of a batch; nothing in it holds on to the lines."""
        frames = tuple(
            FrameHeader(
                frame.sequence,
                frame.exposure_device_ns,
                frame.exposure_host_ns,
                frame.marker,
                frame.flags,
            )
            for frame in batch.frames
        )
        return cls(
            batch.device_id,
            batch.sensor_names,
            batch.calibration_id,
            batch.table_id,
            frames,
            FlatPeaks.of(batch.peaks),
            batch.points,
            batch.owner,
            batch.motion,
            batch.holds,
            tuple({now.release for after in batch.holds for now in after if now.release}),
        )

    def headers(self, first: int, last: int | None) -> Rows:
        """Return the members that each message has, of the frames from ``first`` to ``last``."""
        return [
            {
                "type": "frame",
                "device": self.device_id,
                "sequence": frame.sequence,
                "exposure_ns": frame.exposure_host_ns,
                "device_ns": frame.exposure_device_ns,
                "marker": frame.marker,
                "calibration": self.calibration_id,
                "table": self.table_id,
                "flags": flag_names(frame.flags),
            }
            for frame in self.frames[first:last]
        ]

    def point_rows(self, first: int, count: int) -> Iterator[Rows]:
        """Yield the points of each of ``count`` frames: members of PointEstimate and the marker."""
        starts = self.owner.searchsorted(range(first, first + count + 1)).tolist()
        begin = starts[0]
        own = self.points.part(begin, starts[-1])
        # Straight from the arrays: objects in between cost too much at thousands of frames.
        rows = list(
            zip(
                own.position_mm.tolist(),
                own.covariance_mm2.tolist(),
                own.residual_sigma().tolist(),
                own.used.tolist(),
                own.flags.tolist(),
                strict=True,
            )
        )
        for index in range(count):
            marker = self.frames[first + index].marker
            yield [
                {
                    "marker": marker,
                    "position_mm": position if isfinite(position[0]) else None,
                    "covariance_mm2": covariance if isfinite(position[0]) else None,
                    "residual_sigma": _number(residual),
                    "sensors": _used(self.sensor_names, tuple(used)),
                    "flags": _point_flags(flags),
                }
                for position, covariance, residual, used, flags in rows[
                    starts[index] - begin : starts[index + 1] - begin
                ]
            ]

    def peak_rows(self, first: int, count: int) -> Iterator[Rows]:
        """Yield the peaks of each of ``count`` frames: members of Peak; None: not a number."""
        names = self.sensor_names
        lines = self.peaks.start[first * len(names) : (first + count) * len(names) + 1].tolist()
        begin, end = (lines[0], lines[-1]) if lines else (0, 0)
        rows = list(
            zip(
                *self.peaks.values[:, begin:end].tolist(),
                self.peaks.flags[begin:end].tolist(),
                strict=True,
            )
        )
        for index in range(count):
            yield [
                {
                    "sensor": name,
                    "position_px": position,
                    "sigma_px": sigma,
                    "amplitude": amplitude,
                    "width_px": width,
                    "reduced_chi2": _number(chi2),
                    "flags": _peak_flags(flags),
                }
                for line, name in enumerate(names, index * len(names))
                for position, sigma, amplitude, width, chi2, flags in rows[
                    lines[line] - begin : lines[line + 1] - begin
                ]
            ]

    def track_rows(self, first: int, count: int) -> Iterator[Rows]:
        """Yield the tracks of each of ``count`` frames; none where nothing is tracked."""
        motion = self.motion
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
                "state": _TRACK_STATES[state],
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

    def tool_rows(self, first: int, count: int) -> Iterator[Rows]:
        """Yield the tool poses of each of ``count`` frames; none where nothing is tracked."""
        motion = self.motion
        for frame in range(first, first + count):
            yield [] if motion is None else [pose_members(pose) for pose in motion.poses_of(frame)]

    def hold_rows(self, first: int, count: int) -> Iterator[Rows]:
        """Yield the beam holds after each of ``count`` frames, as they stand now."""
        for index in range(first, first + count):
            yield [hold_members(now) for now in self.holds[index]] if self.holds else []


def hold_members(now: BeamHoldState) -> dict[str, Any]:
    """Return a beam hold as a message has it: held, where it was held since."""
    now = now.standing
    return {
        "hold": now.hold_id,
        "held": now.held,
        "cause": now.cause.value,
        "reason": now.reason,
        "since_ns": now.since_ns,
        "shift_mm": now.shift_mm,
        "rotation_rad": now.rotation_rad,
        "probability": now.probability,
    }


@lru_cache(maxsize=4096)
def _used(names: tuple[str, ...], used: tuple[bool, ...]) -> tuple[str, ...]:
    return tuple(name for name, use in zip(names, used, strict=True) if use)


@lru_cache
def _point_flags(flags: int) -> tuple[str, ...]:
    return flag_names(PointFlag(flags))


@lru_cache
def _peak_flags(flags: int) -> tuple[str, ...]:
    return flag_names(PeakFlag(flags))


@lru_cache
def _track_flags(flags: int) -> tuple[str, ...]:
    return flag_names(TrackFlag(flags))


_TRACK_STATES = {int(state): state.name.lower() for state in TrackState}


def _number(value: float) -> float | None:
    """Return None for what is not a number, which JSON has no word for."""
    return value if isfinite(value) else None
