"""Messages of the stream: frames as the streams keep them, as plain values, and encoded."""

import json
from collections.abc import Iterable, Iterator
from functools import lru_cache
from itertools import pairwise
from math import isfinite
from operator import attrgetter
from typing import Any, Final, Literal, NamedTuple, Protocol, Self, cast, get_args

import msgpack
import numpy as np
from numpy.typing import NDArray

from compute.flags import flag_names
from compute.reconstruction.point_batch import PointFlag
from compute.signal.peaks import PeakBatch, PeakFlag
from hardware.driver import DeviceDescription
from hardware.line_frame import FrameFlag
from service.pipeline.detection_stage import peak_method
from service.pipeline.frame_batch import (
    BeamEnableToken,
    BeamHoldState,
    FrameBatch,
    pose_members,
    track_members,
)

Content = Literal["points", "peaks", "tracks", "tools", "holds"]
Encoding = Literal["msgpack", "json"]
CONTENTS: Final[tuple[Content, ...]] = get_args(Content)
ENCODINGS: Final[tuple[Encoding, ...]] = get_args(Encoding)

Payload = bytes | str
Rows = list[dict[str, Any]]
"""The points, peaks, tracks, ... of one frame, as a message has them."""


class FrameHeader(NamedTuple):
    """A frame without its pixels; see LineFrame."""

    sequence: int
    exposure_device_ns: int
    exposure_host_ns: int
    marker: int | None
    flags: FrameFlag


_HEADER: Final = attrgetter(*FrameHeader._fields)


class BatchSource(Protocol):
    """A batch that is read when somebody wants its content."""

    device_id: str
    count: int
    """How many frames."""
    holds: tuple[tuple[BeamHoldState, ...], ...]
    """The device's beam holds after each frame; empty: it has none."""

    def __hash__(self) -> int:
        """Return a hash: no two are the same."""
        ...

    def read(self) -> FrameBatch:
        """Return the batch."""
        ...


class UnreadBatch:
    """Frames of one device as the streams keep them until a client wants them.

    Args:
        source: the batch.
    """

    __slots__ = ("_source", "count", "releases")

    def __init__(self, source: BatchSource) -> None:
        self._source = source
        self.count = source.count
        self.releases = enabling_tokens(source.holds)

    def messages(self, content: frozenset[Content], first: int, last: int | None) -> Rows:
        """Return one message for each frame; see ``StreamBatch``."""
        return _read(self._source).messages(content, first, last)


@lru_cache(maxsize=4)
def _read(source: BatchSource) -> "StreamBatch":
    """Read a batch once for all clients that want the newest, of any content."""
    return StreamBatch(source.read())


def enabling_tokens(
    holds: tuple[tuple[BeamHoldState, ...], ...],
) -> tuple[BeamEnableToken, ...]:
    """Return the tokens of all holds whose beam is enabled after some frame, each once."""
    return tuple({now.release for after in holds for now in after if now.release})


class _SentPeaks(NamedTuple):
    """Peaks without the room that a PeakBatch has for more.

    Args:
        start: index of the first of the P peaks of each of N scans, and P at the end, shape
            (N + 1,).
        values: position [px], sigma [px], amplitude [counts], width [px] and reduced chi-square
            of each peak, shape (5, P).
        flags: PeakFlag values, shape (P,).
    """

    start: NDArray[np.intp]
    values: NDArray[np.float64]
    flags: NDArray[np.int32]

    @classmethod
    def of(cls, peaks: PeakBatch) -> Self:
        """Return the peaks of N scans."""
        start = np.zeros(len(peaks.count) + 1, dtype=np.intp)
        np.cumsum(peaks.count, out=start[1:])
        there = np.arange(peaks.position_px.shape[1]) < peaks.count[:, None]
        values = (
            peaks.position_px,
            peaks.sigma_px,
            peaks.amplitude,
            peaks.width_px,
            peaks.reduced_chi2,
        )
        columns = np.stack([column[there] for column in values]).astype(np.float64)
        return cls(start, columns, peaks.flags[there])


class StreamBatch:
    """Frames of one device as the streams send them: a FrameBatch without pixels.

    Attributes:
        frames: headers of F frames.
        count: F.
        releases: tokens of all holds whose beam is enabled, each once.
    """

    def __init__(self, batch: FrameBatch) -> None:
        self.device_id = batch.device_id
        self.calibration_id, self.table_id = batch.calibration_id, batch.table_id
        self.radiometric_id = batch.radiometric_id
        self.frames = tuple(FrameHeader._make(_HEADER(frame)) for frame in batch.frames)
        self._sensor_names = batch.sensor_names
        self._points, self._owner = batch.points, batch.owner
        self._motion, self._holds = batch.motion, batch.holds
        self.count = len(batch.frames)
        self.releases = enabling_tokens(batch.holds)
        self._peaks: PeakBatch | _SentPeaks = batch.peaks

    def compact_peaks(self) -> "_SentPeaks":
        """Return the peaks, and keep them alone: the batch's arrays have room for more."""
        if not isinstance(self._peaks, _SentPeaks):
            self._peaks = _SentPeaks.of(self._peaks)
        return self._peaks

    def messages(
        self, content: frozenset[Content], first: int = 0, last: int | None = None
    ) -> Rows:
        """Return one message for each frame, with the chosen content.

        Args:
            content: what each message holds beside the frame itself.
            first: the first frame wanted, from 0.
            last: the frame after the last one wanted; None: to the end.
        """
        messages = self.headers(first, last)
        for name in CONTENTS:
            if name in content:
                rows_by_frame = self.rows(name, first, len(messages))
                for message, rows in zip(messages, rows_by_frame, strict=True):
                    message[name] = rows
        return messages

    def headers(self, first: int, last: int | None) -> Rows:
        """Return the members that each message has, of the frames from ``first`` to ``last``."""
        return [
            {
                "type": "frame",
                "device_id": self.device_id,
                "sequence": frame.sequence,
                "exposure_ns": frame.exposure_host_ns,
                "device_ns": frame.exposure_device_ns,
                "marker": frame.marker,
                "calibration_id": self.calibration_id,
                "table_id": self.table_id,
                "radiometric_id": self.radiometric_id,
                "flags": _frame_flag_names(frame.flags),
            }
            for frame in self.frames[first:last]
        ]

    def rows(self, content: Content, first: int, count: int) -> Iterator[Rows]:
        """Yield the rows of a content of each of ``count`` frames, from ``first`` on."""
        members = {
            "points": self._point_rows,
            "peaks": self._peak_rows,
            "tracks": self._track_rows,
            "tools": self._tool_rows,
            "holds": self._hold_rows,
        }
        return members[content](first, count)

    def _point_rows(self, first: int, count: int) -> Iterator[Rows]:
        """Yield the points: members of PointEstimate and the marker."""
        starts, part = _parts(self._owner, first, count)
        frame_points = self._points
        if part.stop - part.start != len(frame_points):
            frame_points = frame_points.rows(part)
        names = self._sensor_names
        # Straight from the arrays: objects in between cost too much at thousands of frames.
        rows = [
            {
                "marker": self.frames[frame].marker,
                "position_mm": position if isfinite(position[0]) else None,
                "covariance_mm2": covariance if isfinite(position[0]) else None,
                "residual_sigma": residual if isfinite(residual) else None,
                "external_reliability_mm": shift if isfinite(shift) else None,
                "sensors": _used(names, tuple(used)),
                "flags": _flag_names(PointFlag, flags),
            }
            for frame, position, covariance, residual, shift, used, flags in _zip_lists(
                self._owner[part],
                frame_points.position_mm,
                frame_points.covariance_mm2,
                frame_points.residual_sigma(),
                frame_points.external_reliability_mm,
                frame_points.used,
                frame_points.flags,
            )
        ]
        return _split(rows, starts)

    def _peak_rows(self, first: int, count: int) -> Iterator[Rows]:
        """Yield the peaks: members of Peak."""
        names = self._sensor_names
        peaks = self.compact_peaks()
        scans = peaks.start[first * len(names) : (first + count) * len(names) + 1]
        part = slice(scans[0], scans[-1]) if len(scans) else slice(0)
        sensors = np.repeat(np.arange(len(scans) - 1) % len(names), np.diff(scans))
        rows = [
            {
                "sensor": names[sensor],
                "position_px": position,
                "sigma_px": sigma,
                "amplitude": amplitude,
                "width_px": width,
                "reduced_chi2": chi2 if isfinite(chi2) else None,
                "flags": _flag_names(PeakFlag, flags),
            }
            for sensor, position, sigma, amplitude, width, chi2, flags in _zip_lists(
                sensors, *peaks.values[:, part], peaks.flags[part]
            )
        ]
        return _split(rows, scans[:: len(names)].tolist())

    def _track_rows(self, first: int, count: int) -> Iterator[Rows]:
        """Yield the tracks; none where nothing is tracked."""
        if self._motion is None:
            return iter([[]] * count)
        starts, part = _parts(self._motion.track_owner, first, count)
        return _split(track_members(self._motion.tracks, part), starts)

    def _tool_rows(self, first: int, count: int) -> Iterator[Rows]:
        """Yield the tool poses; none where nothing is tracked."""
        motion = self._motion
        for frame in range(first, first + count):
            yield [] if motion is None else [pose_members(pose) for pose in motion.poses_of(frame)]

    def _hold_rows(self, first: int, count: int) -> Iterator[Rows]:
        """Yield the beam holds after each frame, as they stand now."""
        for frame in range(first, first + count):
            yield [hold_members(now) for now in self._holds[frame]] if self._holds else []


def _parts(owner: NDArray[np.intp], first: int, count: int) -> tuple[list[int], slice]:
    """Return where the rows of each of ``count`` frames begin and end, and all of them."""
    if not first and count == 1 and not owner[-1:].any():
        return [0, len(owner)], slice(0, len(owner))  # of a single frame, at no cost
    starts: list[int] = owner.searchsorted(range(first, first + count + 1)).tolist()
    return starts, slice(starts[0], starts[-1])


def _zip_lists(*columns: NDArray[Any]) -> Iterable[tuple[Any, ...]]:
    return zip(*(column.tolist() for column in columns), strict=True)


def _split(rows: Rows, starts: list[int]) -> Iterator[Rows]:
    return (rows[begin - starts[0] : end - starts[0]] for begin, end in pairwise(starts))


@lru_cache(maxsize=4096)
def _used(names: tuple[str, ...], used: tuple[bool, ...]) -> tuple[str, ...]:
    return tuple(name for name, use in zip(names, used, strict=True) if use)


@lru_cache(maxsize=1024)
def _flag_names(kind: type[PointFlag] | type[PeakFlag], flags: int) -> tuple[str, ...]:
    return flag_names(kind(flags))


_frame_flag_names = lru_cache(maxsize=64)(flag_names)


def hold_members(now: BeamHoldState) -> dict[str, Any]:
    """Return a beam hold as a message has it: held, where it was held since."""
    now = now.standing
    return {
        "hold_id": now.hold_id,
        "held": now.held,
        "cause": now.cause.value,
        "reason": now.reason,
        "since_ns": now.since_ns,
        "shift_mm": now.shift_mm,
        "rotation_rad": now.rotation_rad,
        "probability": now.probability,
    }


def hold_message(device_id: str, now: BeamHoldState) -> dict[str, Any]:
    """Return the message about a change of a beam hold: held, where it was held since."""
    return {
        "type": "hold",
        "device_id": device_id,
        **hold_members(now),
        "exposure_ns": now.exposure_ns,
        "sequence": now.sequence,
    }


def state_message(
    device_id: str, state: str, reason: str | None = None, link: str | None = None
) -> dict[str, Any]:
    """Return the message about a change of the device's state, or of its link's."""
    return {"type": "state", "device_id": device_id, "state": state, "reason": reason, "link": link}


def missed_message(device_id: str, messages: int, first: int) -> dict[str, Any]:
    """Return the message to a slow client: how many messages it lacks, and from which on."""
    return {"type": "missed", "device_id": device_id, "messages": messages, "first": first}


def describe_message(description: DeviceDescription | None) -> dict[str, Any]:
    """Return what hello and status messages say of a device; None: it was never started."""
    return {
        "sensors": [sensor.name for sensor in description.sensors] if description else [],
        "frame_rate_hz": description.frame_rate_hz if description else None,
        "markers": description.markers if description else None,
        "readout": description.readout if description else None,
        "method": peak_method(description) if description else None,
    }


def encode(message: dict[str, Any], encoding: Encoding) -> Payload:
    """Encode one message: a binary frame of MessagePack, or a text frame of JSON."""
    if encoding == "msgpack":
        packed: bytes = msgpack.packb(message)
        return packed
    return json.dumps(message, allow_nan=False, separators=(",", ":"))


def bundle(device_id: str, frames: list[Payload], encoding: Encoding) -> Payload:
    """Return one message with many frames, which are encoded already."""
    if encoding == "msgpack":
        packer = msgpack.Packer(autoreset=False)
        packer.pack_map_header(3)
        for word in ("type", "frames", "device_id", device_id, "frames"):
            packer.pack(word)
        packer.pack_array_header(len(frames))
        return b"".join((packer.bytes(), *cast("list[bytes]", frames)))
    head = json.dumps({"type": "frames", "device_id": device_id}, separators=(",", ":"))
    return f'{head[:-1]},"frames":[{",".join(cast("list[str]", frames))}]}}'
