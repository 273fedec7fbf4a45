"""Contents of the types of messages: poses, points, texts, statuses, and what asks for them."""

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from compute.camera.rotation import rotation_quaternion
from service.protocols.openigtlink.message import TYPE_BYTES, BadMessage, decoded, encoded

Array = NDArray[np.float64]
Tracking = Literal["TDATA", "QTDATA"]

TRANSFORM_BYTES: Final = 48
SIX_DOF: Final = 2
"""The kind of instrument that position and orientation are known of."""
_POSITION: Final = struct.Struct(">7f")
_NAMED: Final = struct.Struct(">20sBx")
_START: Final = struct.Struct(">I32s")
_POINT: Final = struct.Struct(">64s32s4B3ff20s")


@dataclass(frozen=True, eq=False)
class ToolTransform:
    """One instrument of TDATA or QTDATA.

    Args:
        name: at most 20 bytes.
        rotation: shape (3, 3).
        translation_mm: shape (3,) [mm].
        kind: SIX_DEGREES, or another of the protocol.
    """

    name: str
    rotation: Array
    translation_mm: Array
    kind: int = SIX_DOF


@dataclass(frozen=True)
class StartStream:
    """What STT_TDATA and STT_QTDATA ask for.

    Args:
        resolution_ms: least time between two messages [ms]; 0: every frame.
        frame: name of the coordinate system; empty: each tool's own.
    """

    resolution_ms: int = 0
    frame: str = ""


@dataclass(frozen=True)
class Point:
    """One point of POINT.

    Args:
        name: at most 64 bytes.
        group: what kind of point: ``Marker``, ``Landmark``, ...; at most 32 bytes.
        position_mm: its coordinates [mm].
        colour: red, green, blue and opacity, 0 to 255.
        diameter_mm: 0: none.
        owner: what it belongs to; at most 20 bytes.
    """

    name: str
    group: str
    position_mm: tuple[float, float, float]
    colour: tuple[int, int, int, int] = (255, 255, 0, 255)
    diameter_mm: float = 0.0
    owner: str = ""


def write_transform(rotation: Array, translation_mm: Array) -> bytes:
    """Return TRANSFORM's content: the columns of the rotation, then the translation, float32."""
    columns = np.empty(12, dtype=">f4")
    columns[:9] = rotation.T.ravel()
    columns[9:] = translation_mm
    return columns.tobytes()


def read_transform(content: bytes) -> tuple[Array, Array]:
    """Return rotation (3, 3) and translation (3,) [mm] of TRANSFORM; raises BadMessage."""
    _check("TRANSFORM", len(content) == TRANSFORM_BYTES, content)
    columns = np.frombuffer(content, dtype=">f4").astype(np.float64)
    return columns[:9].reshape(3, 3).T, columns[9:]


def write_position(rotation: Array, translation_mm: Array) -> bytes:
    """Return POSITION's content: the translation, then the quaternion, its scalar part last."""
    scalar, *vector = rotation_quaternion(rotation)
    return _POSITION.pack(*translation_mm, *vector, scalar)


def read_position(content: bytes) -> tuple[Array, Array]:
    """Return translation (3,) [mm] and quaternion (4,), scalar last, of POSITION.

    Raises:
        BadMessage: it has another size; the short forms of the protocol's first version too.
    """
    _check("POSITION", len(content) == _POSITION.size, content)
    values = np.array(_POSITION.unpack(content))
    return values[:3], values[3:]


def write_tracking(kind: Tracking, tools: Iterable[ToolTransform]) -> bytes:
    """Return the content of TDATA or QTDATA; names are to fit."""
    write = write_transform if kind == "TDATA" else write_position
    return b"".join(
        _NAMED.pack(tool.name.encode(), tool.kind) + write(tool.rotation, tool.translation_mm)
        for tool in tools
    )


def read_tdata(content: bytes) -> tuple[ToolTransform, ...]:
    """Return the instruments of TDATA; raises BadMessage."""
    size = _NAMED.size + TRANSFORM_BYTES
    _check("TDATA", len(content) % size == 0, content)
    found = []
    for at in range(0, len(content), size):
        name, kind = _NAMED.unpack_from(content, at)
        transform = read_transform(content[at + _NAMED.size : at + size])
        found.append(ToolTransform(read_text(name), *transform, kind))
    return tuple(found)


def read_qtdata(content: bytes) -> tuple[tuple[str, Array, Array], ...]:
    """Return name, translation [mm] and quaternion, scalar last, of each; raises BadMessage."""
    size = _NAMED.size + _POSITION.size
    _check("QTDATA", len(content) % size == 0, content)
    return tuple(
        (
            read_text(_NAMED.unpack_from(content, at)[0]),
            *read_position(content[at + _NAMED.size : at + size]),
        )
        for at in range(0, len(content), size)
    )


def write_start(start: StartStream) -> bytes:
    """Return the content of STT_TDATA or STT_QTDATA."""
    return _START.pack(start.resolution_ms, truncate(start.frame, 32))


def read_start(kind: str, content: bytes) -> StartStream:
    """Return what is asked for; without content, or without a frame's name, the defaults.

    Raises:
        BadMessage: it has another size.
    """
    if not content:
        return StartStream()
    _check(kind, len(content) in (4, _START.size), content)
    resolution, frame = _START.unpack(content.ljust(_START.size, b"\0"))
    return StartStream(resolution, read_text(frame))


def write_points(points: Sequence[Point]) -> bytes:
    """Return POINT's content; longer names are cut."""
    return b"".join(
        _POINT.pack(
            truncate(point.name, 64),
            truncate(point.group, 32),
            *point.colour,
            *point.position_mm,
            point.diameter_mm,
            truncate(point.owner, 20),
        )
        for point in points
    )


def read_points(content: bytes) -> tuple[Point, ...]:
    """Return the points of POINT; raises BadMessage."""
    _check("POINT", len(content) % _POINT.size == 0, content)
    return tuple(
        Point(
            read_text(name), read_text(group), (x, y, z), (r, g, b, a), diameter, read_text(owner)
        )
        for name, group, r, g, b, a, x, y, z, diameter, owner in _POINT.iter_unpack(content)
    )


def truncate(text: str, room: int) -> bytes:
    """Return a text's bytes, cut to the room without breaking a character."""
    return text.encode()[:room].decode(errors="ignore").encode()


def read_text(field: bytes) -> str:
    """Return what stands in a field of fixed size."""
    return field.partition(b"\0")[0].decode(errors="replace")


def _check(kind: str, fits: bool, content: bytes) -> None:
    if not fits:
        raise BadMessage(f"{kind}: {len(content)} bytes are not the size of its content")


MAX_TEXT_BYTES: Final = 0xFFFF
"""Of a STRING by its format, and of a COMMAND by what the protocol's own library takes."""
_STATUS: Final = struct.Struct(">Hq20s")
_STRING: Final = struct.Struct(">HH")
_COMMAND: Final = struct.Struct(">I128sHI")


class StatusCode(IntEnum):
    """Codes of STATUS that this server sends, in the protocol's words."""

    OK = 1
    UNKNOWN_ERROR = 2
    NOT_FOUND = 4
    ACCESS_DENIED = 5
    TIME_OUT = 7
    OVERFLOW = 8
    CHECKSUM_ERROR = 9
    CONFIGURATION_ERROR = 10
    NOT_ENOUGH_RESOURCE = 11
    UNKNOWN_INSTRUCTION = 12
    NOT_READY = 13
    MANUAL_MODE = 14
    NOT_PRESENT = 16
    SHUT_DOWN = 19


@dataclass(frozen=True)
class Status:
    """STATUS.

    Args:
        code: one of StatusCode.
        name: a word for it, at most 20 bytes.
        text: for a person.
        sub_code: of this program; not used.
    """

    code: int
    name: str
    text: str
    sub_code: int = 0


@dataclass(frozen=True)
class Command:
    """COMMAND, and RTS_COMMAND, its answer.

    Args:
        number: by which the answer is told to be one.
        name: what is to be done, at most 128 bytes.
        text: the rest, as XML.
    """

    number: int
    name: str
    text: str


def write_status(status: Status) -> bytes:
    """Return STATUS's content; the text ends with a zero, as readers in C want it."""
    name = truncate(status.name, 20)
    return _STATUS.pack(status.code, status.sub_code, name) + status.text.encode() + b"\0"


def read_status(content: bytes) -> Status:
    """Return what a STATUS says; raises BadMessage."""
    if len(content) < _STATUS.size:
        raise BadMessage(f"STATUS: {len(content)} bytes; it has at least {_STATUS.size}")
    code, sub_code, name = _STATUS.unpack_from(content)
    return Status(code, read_text(name), read_text(content[_STATUS.size :]), sub_code)


def write_string(text: str) -> bytes:
    """Return STRING's content; a longer text is cut."""
    encoding, value = encoded(truncate(text, MAX_TEXT_BYTES).decode())
    return _STRING.pack(encoding, len(value)) + value


def read_string(content: bytes) -> str:
    """Return a STRING's text; raises BadMessage."""
    if len(content) < _STRING.size:
        raise BadMessage(f"STRING: {len(content)} bytes; it has at least {_STRING.size}")
    encoding, size = _STRING.unpack_from(content)
    if size != len(content) - _STRING.size:
        raise BadMessage(f"STRING: it says {size} bytes of text in {len(content)}")
    return decoded(encoding, content[_STRING.size :])


def write_command(command: Command) -> bytes:
    """Return the content of COMMAND or RTS_COMMAND; a longer text is cut."""
    encoding, value = encoded(truncate(command.text, MAX_TEXT_BYTES).decode())
    name = truncate(command.name, 128)
    return _COMMAND.pack(command.number, name, encoding, len(value)) + value


def read_command(content: bytes) -> Command:
    """Return a COMMAND; raises BadMessage."""
    if len(content) < _COMMAND.size:
        raise BadMessage(f"COMMAND: {len(content)} bytes; it has at least {_COMMAND.size}")
    number, name, encoding, size = _COMMAND.unpack_from(content)
    if size != len(content) - _COMMAND.size:
        raise BadMessage(f"COMMAND: it says {size} bytes of text in {len(content)}")
    return Command(number, read_text(name), decoded(encoding, content[_COMMAND.size :]))


def write_capability(types: Iterable[str]) -> bytes:
    """Return CAPABILITY's content: names of types, of at most 12 bytes."""
    return b"".join(one.encode().ljust(TYPE_BYTES, b"\0") for one in types)


def read_capability(content: bytes) -> tuple[str, ...]:
    """Return the types that CAPABILITY names; raises BadMessage."""
    if len(content) % TYPE_BYTES:
        raise BadMessage(f"CAPABILITY: {len(content)} bytes are no names of {TYPE_BYTES} each")
    starts = range(0, len(content), TYPE_BYTES)
    return tuple(read_text(content[at : at + TYPE_BYTES]) for at in starts)


def write_result(*, done: bool) -> bytes:
    """Return the content of RTS_TDATA and the like."""
    return b"\0" if done else b"\1"
