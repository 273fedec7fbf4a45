"""Contents of TRANSFORM, POSITION, TDATA, QTDATA and POINT, and of what asks for them."""

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from compute.camera.rotation import rotation_quaternion
from service.protocols.openigtlink.errors import BadMessage

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
