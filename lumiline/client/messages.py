"""Messages of a stream (docs/reference/stream.md). Lengths mm, angles rad, times ns."""

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from typing import Any, Final, TypeVar

from lumiline.client.errors import UnreadableMessage

Vector = tuple[float, ...]
Matrix = tuple[Vector, ...]


@dataclass(frozen=True, slots=True)
class BeamHoldSample:
    """State of a beam hold; the beam may be on only where ``held`` is false."""

    hold_id: str
    held: bool
    cause: str
    reason: str | None
    since_ns: int
    shift_mm: Vector | None = None
    rotation_rad: Vector | None = None
    probability: float | None = None


@dataclass(frozen=True, slots=True)
class BeamHoldEvent:
    """A change of a beam hold's state or cause; sent at once."""

    n: int
    device_id: str
    hold_id: str
    held: bool
    cause: str
    reason: str | None
    since_ns: int
    exposure_ns: int | None
    sequence: int | None
    shift_mm: Vector | None = None
    rotation_rad: Vector | None = None
    probability: float | None = None


@dataclass(frozen=True, slots=True)
class Hello:
    """The first message of each connection.

    ``resumed`` is true where a lossless stream continues without a gap.
    """

    version: int
    device_id: str
    content: tuple[str, ...]
    mode: str
    stream: str
    next: int
    resumed: bool
    sensors: tuple[str, ...]
    frame_rate_hz: float | None
    markers: int | None
    readout: str | None
    method: str | None
    state: str
    reason: str | None
    link: str | None
    calibration_id: str | None
    holds: tuple[BeamHoldSample, ...] | None = None
    radiometric_id: str | None = None


@dataclass(frozen=True, slots=True)
class DeviceState:
    """The device's state changed."""

    n: int
    device_id: str
    state: str
    reason: str | None
    link: str | None = None
    sensors: tuple[str, ...] | None = None
    frame_rate_hz: float | None = None
    markers: int | None = None
    readout: str | None = None
    method: str | None = None


@dataclass(frozen=True, slots=True)
class Missed:
    """Messages that were dropped because this client was too slow: number of the first, count."""

    device_id: str
    messages: int
    first: int

    @property
    def last(self) -> int:
        """Number of the last of them."""
        return self.first + self.messages - 1


@dataclass(frozen=True, slots=True)
class Point:
    """A reconstructed point; no position where ``flags`` say why not."""

    marker: int | None
    position_mm: Vector | None
    covariance_mm2: Matrix | None
    residual_sigma: float | None
    external_reliability_mm: float | None
    sensors: tuple[str, ...]
    flags: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Peak:
    """A peak: the image of a marker on a sensor."""

    sensor: str
    position_px: float
    sigma_px: float
    amplitude: float
    width_px: float
    reduced_chi2: float | None
    flags: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Track:
    """A marker over time; ``state`` is tentative, confirmed or coasting (predicted).

    Without covariances where ``flags`` hold ``no-covariance``.
    """

    id: int
    marker: int | None
    state: str
    flags: tuple[str, ...]
    position_mm: Vector
    covariance_mm2: Matrix | None
    velocity_mm_s: Vector
    velocity_covariance_mm2_s2: Matrix | None
    acceleration_mm_s2: Vector | None
    peaks: tuple[int | None, ...]
    nis: float | None
    dof: int


@dataclass(frozen=True, slots=True)
class ToolPose:
    """A tool's pose; use it only where ``status`` is OK, otherwise ``reason`` says why.

    ``covariance`` is that of a small rotation about the world's axes (left perturbation) and of the
    translation, in this order.
    """

    tool_id: str
    status: str
    reason: str | None
    translation_mm: Vector | None
    rotation: Matrix | None
    quaternion_wxyz: Vector | None
    covariance: Matrix | None
    tip_mm: Vector | None
    tip_covariance_mm2: Matrix | None
    residual_sigma: float | None
    markers_used: int
    readings_used: int
    velocity_mm_s: Vector | None = None
    angular_velocity_rad_s: Vector | None = None
    detectable_sigma: float | None = None
    external_tip_mm: float | None = None
    external_rotation_rad: float | None = None

    @property
    def valid(self) -> bool:
        """Whether it may be used for navigation."""
        return self.status == "OK"


@dataclass(frozen=True, slots=True)
class Frame:
    """One exposure; content that was not requested is None."""

    n: int
    device_id: str
    sequence: int
    exposure_ns: int
    device_ns: int
    marker: int | None
    calibration_id: str | None
    table_id: str | None
    flags: tuple[str, ...]
    points: tuple[Point, ...] | None = None
    peaks: tuple[Peak, ...] | None = None
    tracks: tuple[Track, ...] | None = None
    tools: tuple[ToolPose, ...] | None = None
    holds: tuple[BeamHoldSample, ...] | None = None
    radiometric_id: str | None = None


@dataclass(frozen=True, slots=True)
class UnknownMessage:
    """A message of a type that this client does not know; a newer server may send it."""

    type: str
    members: Mapping[str, Any] = field(default_factory=dict)


Message = Hello | Frame | DeviceState | BeamHoldEvent | Missed | UnknownMessage

T = TypeVar("T")

_KINDS: Final[dict[str, type[Any]]] = {
    "hello": Hello,
    "frame": Frame,
    "state": DeviceState,
    "hold": BeamHoldEvent,
    "missed": Missed,
}
_PARTS: Final[dict[str, type[Any]]] = {
    "points": Point,
    "peaks": Peak,
    "tracks": Track,
    "tools": ToolPose,
    "holds": BeamHoldSample,
}
_MEMBERS: Final[dict[type[Any], tuple[tuple[str, bool], ...]]] = {
    kind: tuple((member.name, member.default is MISSING) for member in fields(kind))
    for kind in (*_KINDS.values(), *_PARTS.values())
}
"""Members of each kind by name, and whether a message must have them."""


def messages_of(payload: object) -> tuple[Message, ...]:
    """Return the messages of a decoded payload: one, or those of a bundle.

    Raises:
        UnreadableMessage: the payload is no message.
    """
    if not isinstance(payload, dict) or not isinstance(payload.get("type"), str):
        raise UnreadableMessage(f"a message of the stream has no type: {str(payload)[:100]}")
    if payload["type"] == "frames":
        bundled = payload.get("frames")
        if not isinstance(bundled, list):
            raise UnreadableMessage("a bundle of the stream has no frames")
        return tuple(message for frame in bundled for message in messages_of(frame))
    kind = _KINDS.get(payload["type"])
    if kind is None:
        members = {key: value for key, value in payload.items() if key != "type"}
        return (UnknownMessage(payload["type"], members),)
    if kind in (Frame, Hello):
        payload = dict(payload)
        for name, part in _PARTS.items():
            if payload.get(name) is not None:
                payload[name] = tuple(_decode(part, item) for item in payload[name])
    found: Message = _decode(kind, payload)
    return (found,)


def _decode(kind: type[T], payload: object) -> T:
    """Return a message from its members; unknown members are ignored."""
    if not isinstance(payload, dict):
        raise UnreadableMessage(f"a {kind.__name__} of the stream is {str(payload)[:100]}")
    values = {}
    for name, needed in _MEMBERS[kind]:
        if name in payload:
            value = payload[name]
            values[name] = _to_tuple(value) if isinstance(value, list) else value
        elif needed:
            raise UnreadableMessage(f"a {kind.__name__} of the stream has no {name}")
    return kind(**values)


def _to_tuple(value: list[Any]) -> tuple[Any, ...]:
    return tuple(_to_tuple(item) if isinstance(item, list) else item for item in value)
