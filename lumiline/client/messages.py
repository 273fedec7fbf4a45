"""What a stream sends, typed (docs/reference/stream.md). Lengths mm, angles rad, times ns."""

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from typing import Any, Final, TypeVar

from lumiline.client.errors import UnreadableMessage

Vector = tuple[float, ...]
Matrix = tuple[Vector, ...]


@dataclass(frozen=True, slots=True)
class BeamHoldSample:
    """Whether a beam is held: only ``held`` false lets it go on. ``reason`` says why it is."""

    hold: str
    held: bool
    cause: str
    reason: str | None
    since_ns: int
    shift_mm: Vector | None = None
    rotation_rad: Vector | None = None
    probability: float | None = None


@dataclass(frozen=True, slots=True)
class BeamHoldEvent:
    """A beam is held now, or is not any more, or for another cause; sent at once."""

    n: int
    device: str
    hold: str
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
    """The first message of a connection, and of every one that follows a lost one.

    ``resumed`` is true where a lossless stream goes on without a gap.
    """

    version: int
    device: str
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
    calibration: str | None
    holds: tuple[BeamHoldSample, ...] | None = None


@dataclass(frozen=True, slots=True)
class Status:
    """The device's state changed."""

    n: int
    device: str
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
    """Messages that this client was too slow for: how many, and the number of the first."""

    device: str
    messages: int
    first: int


@dataclass(frozen=True, slots=True)
class Point:
    """A reconstructed point; no position where ``flags`` say why not."""

    marker: int | None
    position_mm: Vector | None
    covariance_mm2: Matrix | None
    residual_sigma: float | None
    sensors: tuple[str, ...]
    flags: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Peak:
    """A line of light on a sensor."""

    sensor: str
    position_px: float
    sigma_px: float
    amplitude: float
    width_px: float
    reduced_chi2: float | None
    flags: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Track:
    """A marker over time; ``state`` is tentative, confirmed or coasting (predicted)."""

    id: int
    marker: int | None
    state: str
    flags: tuple[str, ...]
    position_mm: Vector
    covariance_mm2: Matrix
    velocity_mm_s: Vector
    velocity_covariance_mm2_s2: Matrix
    acceleration_mm_s2: Vector | None
    peaks: tuple[int | None, ...]
    nis: float | None
    dof: int


@dataclass(frozen=True, slots=True)
class ToolPose:
    """A tool's pose; only one whose ``status`` is OK is one to use, else ``reason`` says why.

    ``covariance`` is of a small turn about the world's axes, on the left, and of the translation,
    in this order.
    """

    tool: str
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

    @property
    def valid(self) -> bool:
        """Whether it may be used for navigation."""
        return self.status == "OK"


@dataclass(frozen=True, slots=True)
class Frame:
    """One exposure, with the content that was asked for; None: it was not."""

    n: int
    device: str
    sequence: int
    exposure_ns: int
    device_ns: int
    marker: int | None
    calibration: str | None
    table: str | None
    flags: tuple[str, ...]
    points: tuple[Point, ...] | None = None
    peaks: tuple[Peak, ...] | None = None
    tracks: tuple[Track, ...] | None = None
    tools: tuple[ToolPose, ...] | None = None
    holds: tuple[BeamHoldSample, ...] | None = None


@dataclass(frozen=True, slots=True)
class UnknownMessage:
    """A message of a kind that this client does not know; newer servers may send such."""

    type: str
    members: Mapping[str, Any] = field(default_factory=dict)


Message = Hello | Frame | Status | BeamHoldEvent | Missed | UnknownMessage

T = TypeVar("T")

_KINDS: Final[dict[str, type[Any]]] = {
    "hello": Hello,
    "frame": Frame,
    "status": Status,
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
    kind: tuple((one.name, one.default is MISSING) for one in fields(kind))
    for kind in (*_KINDS.values(), *_PARTS.values())
}
"""Members of each kind by name, and whether a message must have them."""


def messages_of(given: object) -> tuple[Message, ...]:
    """Return the messages in what was decoded: one, or those of a bundle.

    Raises:
        UnreadableMessage: it is no message.
    """
    if not isinstance(given, dict) or not isinstance(given.get("type"), str):
        raise UnreadableMessage(f"a message of the stream has no type: {str(given)[:100]}")
    if given["type"] == "frames":
        bundled = given.get("frames")
        if not isinstance(bundled, list):
            raise UnreadableMessage("a bundle of the stream has no frames")
        return tuple(one for frame in bundled for one in messages_of(frame))
    kind = _KINDS.get(given["type"])
    if kind is None:
        return (
            UnknownMessage(
                given["type"], {key: one for key, one in given.items() if key != "type"}
            ),
        )
    if kind in (Frame, Hello):
        given = dict(given)
        for name, part in _PARTS.items():
            if given.get(name) is not None:
                given[name] = tuple(_decode(part, one) for one in given[name])
    found: Message = _decode(kind, given)
    return (found,)


def _decode(kind: type[T], given: object) -> T:
    """Return a message from its members; those that are not known are left aside."""
    if not isinstance(given, dict):
        raise UnreadableMessage(f"a {kind.__name__} of the stream is {str(given)[:100]}")
    values = {}
    for name, needed in _MEMBERS[kind]:
        if name in given:
            value = given[name]
            values[name] = _frozen(value) if isinstance(value, list) else value
        elif needed:
            raise UnreadableMessage(f"a {kind.__name__} of the stream has no {name}")
    return kind(**values)


def _frozen(value: list[Any]) -> tuple[Any, ...]:
    return tuple(_frozen(one) if isinstance(one, list) else one for one in value)
