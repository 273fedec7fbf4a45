"""Messages of the bus: batches, beam holds, states and figures of devices, as bytes.

A message is a header in MessagePack, which begins with its kind. A batch has its details behind it,
and the arrays' bytes in a fixed order: it is read when somebody wants its content, and comes back
as it was, to the bit; without its pixels where nobody wants them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from functools import lru_cache
from operator import attrgetter
from typing import Any, Final, Protocol

import msgpack
import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from compute.pose.beam_hold import BeamHoldCause
from compute.pose.rigid_body import PoseStatus, ToolPose
from compute.reconstruction.point_batch import PointBatch
from compute.signal.peaks import PeakBatch
from compute.tracking.track_batch import TrackBatch
from hardware.driver import DeviceDescription
from hardware.line_frame import FrameFlag, LineFrame
from service.pipeline.active_calibration import LiveBadPixel
from service.pipeline.device_status import DeviceStatus
from service.pipeline.frame_batch import (
    BeamEnableToken,
    BeamHoldState,
    FrameBatch,
    PoseEntry,
    TrackingResult,
)
from service.pipeline.stage_latency import Stage


class MessageKind(IntEnum):
    """What a message is."""

    BATCH = 0
    HOLD = 1
    STATE = 2
    CALIBRATION = 3
    FIGURES = 4
    END = 5
    POSES = 6
    RENEWAL = 7
    PRESENCE = 8
    PREPARED = 9


class HoldTokens(Protocol):
    """The tokens of beam holds in the process that reads the bus."""

    def enabled(self, hold_id: str, revision: int, due_s: float) -> BeamEnableToken:
        """Return the token of a state that is not held, with its deadline (``time.monotonic``)."""
        ...

    def held(self, now: BeamHoldState) -> None:
        """End the token of a hold: this state is held."""
        ...


_Spec = tuple[str, np.dtype[Any]]


def _spec(**types: type) -> tuple[_Spec, ...]:
    return tuple((name, np.dtype(kind)) for name, kind in types.items())


_PEAKS: Final = _spec(
    position_px=np.float64,
    sigma_px=np.float32,
    amplitude=np.float32,
    width_px=np.float32,
    reduced_chi2=np.float32,
    covariance_px2=np.float32,
    count=np.int32,
    flags=np.int32,
)
_POINTS: Final = _spec(
    position_mm=np.float64,
    covariance_mm2=np.float64,
    chi2=np.float64,
    external_reliability_mm=np.float64,
    flags=np.int32,
    used=np.bool_,
)
_TRACKS: Final = _spec(
    identity=np.int64,
    position_mm=np.float64,
    velocity_mm_s=np.float64,
    acceleration_mm_s2=np.float64,
    covariance=np.float64,
    nis=np.float64,
    marker=np.int32,
    flags=np.int32,
    peaks=np.int32,
    dof=np.int32,
    state=np.int8,
)
"""Members of the batches with their types, wide ones first, so that each array is aligned."""
_OWNER: Final = np.dtype(np.intp)
_PIXELS: Final = np.dtype(np.uint16)
_ALIGNMENT: Final = 8

_FRAME: Final = attrgetter(
    "sequence", "exposure_device_ns", "exposure_host_ns", "marker", "flags", "lines"
)
_POSE_ARRAYS: Final[tuple[tuple[str, tuple[int, ...]], ...]] = (
    ("rotation", (3, 3)),
    ("translation_mm", (3,)),
    ("covariance", (6, 6)),
    ("tip_mm", (3,)),
    ("tip_covariance_mm2", (3, 3)),
    ("velocity_mm_s", (3,)),
    ("angular_velocity_rad_s", (3,)),
)
_POSE_VALUES: Final = (
    "tool",
    "reason",
    "exposure_ns",
    "sequence",
    "residual_sigma",
    "markers_used",
    "readings_used",
    "unseen_ns",
    "detectable_sigma",
    "external_tip_mm",
    "external_rotation_rad",
)
_pose_arrays: Final = attrgetter(*(name for name, _ in _POSE_ARRAYS))
_pose_values: Final = attrgetter(*_POSE_VALUES)
_HOLD_VALUES: Final = (
    "hold_id",
    "held",
    "reason",
    "since_ns",
    "exposure_ns",
    "sequence",
    "shift_mm",
    "rotation_rad",
    "probability",
    "revision",
)
_hold_values: Final = attrgetter(*_HOLD_VALUES)


class _Writer:
    """Collects arrays, and their shapes, behind one another."""

    def __init__(self) -> None:
        self.shapes: list[tuple[int, ...]] = []
        self.parts: list[bytes] = []
        self._size = 0

    def add(self, array: NDArray[Any], kind: np.dtype[Any]) -> None:
        """Add an array as one of this type."""
        self.shapes.append(array.shape)
        if array.dtype != kind:
            array = array.astype(kind)
        self._append(array.tobytes())

    def add_members(self, batch: object, members: Sequence[_Spec]) -> None:
        """Add the arrays of a batch."""
        for name, kind in members:
            self.add(getattr(batch, name), kind)
        self.align()

    def align(self) -> None:
        """Let the next array begin where any type may."""
        if self._size % _ALIGNMENT:
            self._append(b"\0" * (-self._size % _ALIGNMENT))

    def _append(self, part: bytes) -> None:
        self.parts.append(part)
        self._size += len(part)


class _Reader:
    """Takes arrays out of a message again; they are read-only and share its memory."""

    def __init__(self, data: bytes, at: int, shapes: Sequence[Sequence[int]]) -> None:
        self._data = data
        self._begin = self._at = at
        self._shapes = iter(shapes)

    def take(self, kind: np.dtype[Any]) -> NDArray[Any]:
        """Return the next array, which is of this type."""
        array: NDArray[Any] = np.ndarray(next(self._shapes), kind, self._data, self._at)
        self._at += array.nbytes
        return array

    def take_members(self, members: Sequence[_Spec]) -> dict[str, NDArray[Any]]:
        """Return the next arrays by name."""
        found = {name: self.take(kind) for name, kind in members}
        self.align()
        return found

    def align(self) -> None:
        """Go on where any type may begin."""
        self._at += -(self._at - self._begin) % _ALIGNMENT


def _message(kind: MessageKind, header: Sequence[Any]) -> bytes:
    packed: bytes = msgpack.packb([int(kind), *header])
    return packed


def split_message(data: bytes) -> tuple[MessageKind, list[Any], int]:
    """Return a message's kind, the rest of its header, and where that ends.

    Raises:
        ValueError: it is no message of the bus.
    """
    unpacker = msgpack.Unpacker(max_buffer_size=len(data))
    unpacker.feed(data)
    try:
        kind, *header = unpacker.unpack()
        return MessageKind(kind), header, unpacker.tell()
    except (TypeError, ValueError, msgpack.UnpackException) as error:
        raise ValueError(f"this is no message of the bus: {error}") from error


def batch_message(batch: FrameBatch, *, pixels: bool) -> bytes:
    """Return a batch as a message.

    Args:
        batch: F frames.
        pixels: whether its frames' pixels are wanted.
    """
    writer = _Writer()
    writer.add_members(batch.peaks, _PEAKS)
    writer.add_members(batch.points, _POINTS)
    writer.add(batch.owner, _OWNER)
    poses = None
    motion = batch.motion
    if motion is not None:
        writer.add_members(motion.tracks, _TRACKS)
        writer.add(motion.track_owner, _OWNER)
        writer.add(motion.pose_owner, _OWNER)
        poses = [_pose_row(pose) for pose in motion.poses]
    frames = []
    for frame in batch.frames:
        *row, lines = _FRAME(frame)
        frames.append(row)
        if pixels:
            writer.add(lines, _PIXELS)
    details = msgpack.packb(
        (
            batch.sensor_names,
            batch.calibration_id,
            batch.table_id,
            batch.radiometric_id,
            batch.frames[0].device if batch.frames else batch.device_id,
            frames,
            poses,
            writer.shapes,
        )
    )
    header = (
        batch.device_id,
        len(frames),
        batch.frames[0].sequence if batch.frames else 0,
        batch.frames[-1].sequence if batch.frames else -1,
        [[hold_row(now) for now in after] for after in batch.holds],
        len(details),
        sum(frame.lines.nbytes for frame in batch.frames) if pixels else 0,
    )
    packed = _message(MessageKind.BATCH, header) + details
    return b"".join((packed, bytes(-len(packed) % _ALIGNMENT), *writer.parts))


class BatchMessage:
    """A batch as it came by the bus; what it holds is read when it is first wanted.

    Streams keep many of these, and nobody asks for most: they are bytes, and nothing that the
    garbage collector has to look through.

    Attributes:
        device_id: the device.
        count: how many frames.
        first_sequence: sequence number of the first.
        last_sequence: and of the last.
        holds: the device's beam holds after each frame; empty: it has none.

    Args:
        data: the message.
        header: what ``split_message`` has returned of it.
        end: where that ends.
        tokens: of the holds.
    """

    __slots__ = (
        "_begin",
        "_data",
        "_end",
        "_pixel_bytes",
        "count",
        "device_id",
        "first_sequence",
        "holds",
        "last_sequence",
    )

    def __init__(self, data: bytes, header: Sequence[Any], end: int, tokens: HoldTokens) -> None:
        self._data = data
        self.device_id, self.count, self.first_sequence, self.last_sequence = header[:4]
        holds, details, self._pixel_bytes = header[4:]
        self._begin, self._end = end, end + details
        self.holds = tuple([tuple([read_hold(row, tokens) for row in after]) for after in holds])

    def drop_pixels(self) -> None:
        """Keep the message without its frames' pixels from now on."""
        if self._pixel_bytes:
            self._data = self._data[: -self._pixel_bytes]
            self._pixel_bytes = 0

    def read(self) -> FrameBatch:
        """Return the batch; frames whose pixels were not wanted have empty ``lines``."""
        return _read_batch(self)

    def _read(self) -> FrameBatch:
        details = msgpack.unpackb(memoryview(self._data)[self._begin : self._end])
        (names, calibration_id, table_id, radiometric_id, device, rows, poses, shapes) = details
        reader = _Reader(self._data, -(-self._end // _ALIGNMENT) * _ALIGNMENT, shapes)
        peaks = PeakBatch(**reader.take_members(_PEAKS))
        points = PointBatch(**reader.take_members(_POINTS))
        owner = reader.take(_OWNER)
        motion = None
        if poses is not None:
            tracks = TrackBatch(**reader.take_members(_TRACKS))
            track_owner, pose_owner = reader.take(_OWNER), reader.take(_OWNER)
            motion = TrackingResult(
                tracks, track_owner, tuple([_pose(row) for row in poses]), pose_owner
            )
        frames = tuple(
            [
                LineFrame(
                    device,
                    sequence,
                    device_ns,
                    host_ns,
                    marker,
                    reader.take(_PIXELS) if self._pixel_bytes else _NO_PIXELS,
                    FrameFlag(flags),
                )
                for sequence, device_ns, host_ns, marker, flags in rows
            ]
        )
        return FrameBatch(
            self.device_id,
            tuple(names),
            calibration_id,
            table_id,
            frames,
            peaks,
            points,
            owner,
            motion,
            self.holds,
            radiometric_id,
        )


def without_pixels(data: bytes, header: Sequence[Any], end: int) -> bytes:
    """Return the message of a batch without its frames' pixels.

    Args:
        data: the message.
        header: what ``split_message`` has returned of it.
        end: where that ends.
    """
    *others, details, pixel_bytes = header
    if not pixel_bytes:
        return data
    behind = end + details
    begin = -(-behind // _ALIGNMENT) * _ALIGNMENT
    packed = _message(MessageKind.BATCH, (*others, details, 0)) + data[end:behind]
    arrays = memoryview(data)[begin : len(data) - pixel_bytes]
    return b"".join((packed, bytes(-len(packed) % _ALIGNMENT), arrays))


@lru_cache(maxsize=4)
def _read_batch(message: BatchMessage) -> FrameBatch:
    """Read a batch once for all who want the newest."""
    return message._read()


_NO_PIXELS: Final = np.empty((0, 0), np.uint16)


def _pose_row(pose: ToolPose) -> tuple[Any, ...]:
    arrays = [
        None if array is None else np.asarray(array, np.float64).tobytes()
        for array in _pose_arrays(pose)
    ]
    return (pose.status.value, _pose_values(pose), arrays)


def _pose(row: Sequence[Any]) -> ToolPose:
    status, values, arrays = row
    members = dict(zip(_POSE_VALUES, values, strict=True))
    for (name, shape), array in zip(_POSE_ARRAYS, arrays, strict=True):
        members[name] = None if array is None else np.frombuffer(array).reshape(shape)
    return ToolPose(status=PoseStatus(status), **members)


def hold_row(now: BeamHoldState) -> tuple[Any, ...]:
    """Return the state of a beam hold as plain values, with its token's deadline."""
    due_s = None if now.release is None else now.release.due_s
    return (now.cause.value, due_s, *_hold_values(now))


def read_hold(row: Sequence[Any], tokens: HoldTokens) -> BeamHoldState:
    """Return the state of a beam hold from its plain values."""
    cause, due_s, *values = row
    members = dict(zip(_HOLD_VALUES, values, strict=True))
    for name in ("shift_mm", "rotation_rad"):
        if members[name] is not None:
            members[name] = tuple(members[name])
    if due_s is not None:
        members["release"] = tokens.enabled(members["hold_id"], members["revision"], due_s)
    now = BeamHoldState(cause=BeamHoldCause(cause), **members)
    if now.held:
        tokens.held(now)
    return now


def poses_message(entry: PoseEntry) -> bytes:
    """Return the newest poses of a device; they go before the batch that they are of."""
    return _message(
        MessageKind.POSES,
        (
            entry.device_id,
            entry.sequence,
            entry.exposure_ns,
            [_pose_row(pose) for pose in entry.poses.values()],
            entry.calibration_id,
            entry.frame_rate_hz,
            entry.table_id,
        ),
    )


def read_poses(header: Sequence[Any]) -> PoseEntry:
    """Return the newest poses of a device from the header of their message."""
    device_id, sequence, exposure_ns, rows, *members = header
    poses = {pose.tool: pose for pose in map(_pose, rows)}
    return PoseEntry(device_id, sequence, exposure_ns, poses, *members)


def hold_message(device_id: str, now: BeamHoldState, *, last: bool) -> bytes:
    """Return a change of a beam hold; ``last``: it was deleted."""
    return _message(MessageKind.HOLD, (device_id, hold_row(now), last))


def state_message(
    device_id: str,
    state: str,
    reason: str | None,
    link: str | None = None,
    description: DeviceDescription | None = None,
) -> bytes:
    """Return the state of a device, as ``StreamPublisher.publish_status`` takes it."""
    described = None if description is None else _DESCRIPTION.dump_json(description)
    return _message(MessageKind.STATE, (device_id, state, reason, link, described))


def read_description(data: bytes | None) -> DeviceDescription | None:
    """Return the description of a state's message."""
    return None if data is None else _DESCRIPTION.validate_json(data)


def calibration_message(tap: int, version: int, bad_pixels: Sequence[LiveBadPixel]) -> bytes:
    """Return what batches are processed with from now on, for a tap at the gateway.

    Args:
        tap: its number.
        version: of the calibration that the gateway has sent.
        bad_pixels: that are masked beside.
    """
    masked = _BAD_PIXELS.dump_json(tuple(bad_pixels))
    return _message(MessageKind.CALIBRATION, (tap, version, masked))


def read_bad_pixels(data: bytes) -> tuple[LiveBadPixel, ...]:
    """Return the bad pixels of a calibration's message."""
    return _BAD_PIXELS.validate_json(data)


def renewal_message(device_id: str, rows: Sequence[Any]) -> bytes:
    """Return how the beam holds of a device stand, with their deadlines: nothing has changed.

    Args:
        device_id: the device.
        rows: of ``hold_row``.
    """
    return _message(MessageKind.RENEWAL, (device_id, list(rows)))


def presence_message(packed: bytes) -> bytes:
    """Return what a station says of itself, for other machines."""
    return _message(MessageKind.PRESENCE, (packed,))


def prepared_message(
    device_id: str,
    gateway: str,
    tap: int,
    stored: tuple[str | None, str | None, str | None],
    bad_pixels: Sequence[LiveBadPixel],
) -> bytes:
    """Return what batches are processed with from now on, for a tap at another machine.

    Args:
        device_id: the device.
        gateway: which one.
        tap: its number there.
        stored: ids of calibration, correction table and radiometric calibration.
        bad_pixels: that are masked beside.
    """
    masked = _BAD_PIXELS.dump_json(tuple(bad_pixels))
    return _message(MessageKind.PREPARED, (device_id, gateway, tap, *stored, masked))


def end_message(device_id: str) -> bytes:
    """Return that a device was deleted."""
    return _message(MessageKind.END, (device_id,))


@dataclass(frozen=True)
class DeviceFigures:
    """What is known of a device that was started, or tried to.

    Args:
        status: its status.
        generation: of its start; 0: it never ran.
        description: of its driver; None: it never ran.
        running: whether frames come, or will when it is connected again.
        connected: whether it runs and its device is there.
        drained: whether all frames are processed and no more will come.
        latency: batches by class of latency, and the sum [s].
        stages: frames that were timed, and their time in each stage [s].
        tools: frames by pose status, and the newest OK pose's exposure [ns], by tool.
        peak_settings: method of peak detection and its errors.
    """

    status: DeviceStatus
    generation: int = 0
    description: DeviceDescription | None = None
    running: bool = False
    connected: bool = False
    drained: bool = False
    latency: tuple[tuple[int, ...], float] = ((), 0.0)
    stages: tuple[int, dict[Stage, float]] = (0, {})
    tools: dict[str, tuple[dict[PoseStatus, int], int | None]] = field(default_factory=dict)
    peak_settings: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class StationFigures:
    """Figures of a station, twice a second and at each change.

    Args:
        devices: by id.
        busy_s: time that its compute thread has spent on its current batch [s].
        ready: whether that runs.
        memory_bytes: resident memory of the process.
        cpu_s: computing time that it has used.
    """

    devices: dict[str, DeviceFigures]
    busy_s: float = 0.0
    ready: bool = True
    memory_bytes: int = 0
    cpu_s: float = 0.0


def figures_message(figures: StationFigures) -> bytes:
    """Return the figures of a station as a message."""
    return _message(MessageKind.FIGURES, (_FIGURES.dump_json(figures),))


def read_figures(data: bytes) -> StationFigures:
    """Return the figures of a message."""
    return _FIGURES.validate_json(data)


_DESCRIPTION: Final = TypeAdapter(DeviceDescription)
_BAD_PIXELS: Final = TypeAdapter(tuple[LiveBadPixel, ...])
_FIGURES: Final = TypeAdapter(StationFigures)
