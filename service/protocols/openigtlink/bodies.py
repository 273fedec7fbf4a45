"""Contents of the types of messages: poses, points, texts, statuses, and what asks for them."""

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from compute.transform import rotation_quaternion
from service.protocols.openigtlink.message import TYPE_BYTES, BadMessage, decoded, encoded

Array = NDArray[np.float64]
Tracking = Literal["TDATA", "QTDATA"]

SIX_DOF: Final = 2
"""The kind of instrument that position and orientation are known of."""
POSITION: Final = struct.Struct(">7f")
NAMED: Final = struct.Struct(">20sBx")
START: Final = struct.Struct(">I32s")
POINT: Final = struct.Struct(">64s32s4B3ff20s")


@dataclass(frozen=True)
class StartStream:
    """Request to start a stream: body of STT_TDATA and STT_QTDATA.

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


def write_position(rotation: Array, translation_mm: Array) -> bytes:
    """Return POSITION's content: the translation, then the quaternion, its scalar part last."""
    scalar, *vector = rotation_quaternion(rotation)
    return POSITION.pack(*translation_mm, *vector, scalar)


def write_tracking(kind: Tracking, tools: Iterable[tuple[str, Array, Array]]) -> bytes:
    """Return the content of TDATA or QTDATA.

    Args:
        kind: which of them.
        tools: name of at most 20 bytes, rotation (3, 3) and translation (3,) [mm] of each.
    """
    write = write_transform if kind == "TDATA" else write_position
    return b"".join(
        NAMED.pack(name.encode(), SIX_DOF) + write(rotation, translation_mm)
        for name, rotation, translation_mm in tools
    )


def read_start(kind: str, content: bytes) -> StartStream:
    """Read the request of a stream; without content, or without a frame's name, the defaults.

    Raises:
        BadMessage: it has another size.
    """
    if not content:
        return StartStream()
    check_size(kind, len(content) in (4, START.size), content)
    resolution, frame = START.unpack(content.ljust(START.size, b"\0"))
    return StartStream(resolution, read_text(frame))


def write_points(points: Sequence[Point]) -> bytes:
    """Return POINT's content; longer names are cut."""
    return b"".join(
        POINT.pack(
            truncate(point.name, 64),
            truncate(point.group, 32),
            *point.colour,
            *point.position_mm,
            point.diameter_mm,
            truncate(point.owner, 20),
        )
        for point in points
    )


def truncate(text: str, room: int) -> bytes:
    """Return a text's bytes, cut to the room without breaking a character."""
    return text.encode()[:room].decode(errors="ignore").encode()


def read_text(field: bytes) -> str:
    """Return what stands in a field of fixed size."""
    return field.partition(b"\0")[0].decode(errors="replace")


def check_size(kind: str, fits: bool, content: bytes) -> None:
    """Raise BadMessage where content has not the size of its type."""
    if not fits:
        raise BadMessage(f"{kind}: {len(content)} bytes are not the size of its content")


MAX_TEXT_BYTES: Final = 0xFFFF
"""Of a STRING by its format, and of a COMMAND by what the protocol's own library takes."""
STATUS: Final = struct.Struct(">Hq20s")
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


def write_status(code: int, name: str, text: str, sub_code: int = 0) -> bytes:
    """Return STATUS's content; the text ends with a zero, as readers in C want it."""
    return STATUS.pack(code, sub_code, truncate(name, 20)) + text.encode() + b"\0"


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


def write_result(*, done: bool) -> bytes:
    """Return the content of RTS_TDATA and the like."""
    return b"\0" if done else b"\1"
