"""Readers of what the server only writes, and the writer of what it only reads."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.protocols.openigtlink.bodies import (
    NAMED,
    POINT,
    POSITION,
    SIX_DOF,
    START,
    STATUS,
    Point,
    StartStream,
    check_size,
    read_text,
    truncate,
)
from service.protocols.openigtlink.message import TYPE_BYTES, BadMessage

Array = NDArray[np.float64]

TRANSFORM_BYTES: Final = 48


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


def read_transform(content: bytes) -> tuple[Array, Array]:
    """Return rotation (3, 3) and translation (3,) [mm] of TRANSFORM; raises BadMessage."""
    check_size("TRANSFORM", len(content) == TRANSFORM_BYTES, content)
    columns = np.frombuffer(content, dtype=">f4").astype(np.float64)
    return columns[:9].reshape(3, 3).T, columns[9:]


def read_position(content: bytes) -> tuple[Array, Array]:
    """Return translation (3,) [mm] and quaternion (4,), scalar last, of POSITION.

    Raises:
        BadMessage: it has another size; the short forms of the protocol's first version too.
    """
    check_size("POSITION", len(content) == POSITION.size, content)
    values = np.array(POSITION.unpack(content))
    return values[:3], values[3:]


def read_tdata(content: bytes) -> tuple[ToolTransform, ...]:
    """Return the instruments of TDATA; raises BadMessage."""
    size = NAMED.size + TRANSFORM_BYTES
    check_size("TDATA", len(content) % size == 0, content)
    found = []
    for at in range(0, len(content), size):
        name, kind = NAMED.unpack_from(content, at)
        transform = read_transform(content[at + NAMED.size : at + size])
        found.append(ToolTransform(read_text(name), *transform, kind))
    return tuple(found)


def read_qtdata(content: bytes) -> tuple[tuple[str, Array, Array], ...]:
    """Return name, translation [mm] and quaternion, scalar last, of each; raises BadMessage."""
    size = NAMED.size + POSITION.size
    check_size("QTDATA", len(content) % size == 0, content)
    return tuple(
        (
            read_text(NAMED.unpack_from(content, at)[0]),
            *read_position(content[at + NAMED.size : at + size]),
        )
        for at in range(0, len(content), size)
    )


def write_start(start: StartStream) -> bytes:
    """Return the content of STT_TDATA or STT_QTDATA."""
    return START.pack(start.resolution_ms, truncate(start.frame, 32))


def read_points(content: bytes) -> tuple[Point, ...]:
    """Return the points of POINT; raises BadMessage."""
    check_size("POINT", len(content) % POINT.size == 0, content)
    return tuple(
        Point(
            read_text(name), read_text(group), (x, y, z), (r, g, b, a), diameter, read_text(owner)
        )
        for name, group, r, g, b, a, x, y, z, diameter, owner in POINT.iter_unpack(content)
    )


def read_status(content: bytes) -> Status:
    """Return what a STATUS says; raises BadMessage."""
    if len(content) < STATUS.size:
        raise BadMessage(f"STATUS: {len(content)} bytes; it has at least {STATUS.size}")
    code, sub_code, name = STATUS.unpack_from(content)
    return Status(code, read_text(name), read_text(content[STATUS.size :]), sub_code)


def read_capability(content: bytes) -> tuple[str, ...]:
    """Return the types that CAPABILITY names; raises BadMessage."""
    if len(content) % TYPE_BYTES:
        raise BadMessage(f"CAPABILITY: {len(content)} bytes are no names of {TYPE_BYTES} each")
    starts = range(0, len(content), TYPE_BYTES)
    return tuple(read_text(content[at : at + TYPE_BYTES]) for at in starts)
