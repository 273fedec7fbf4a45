"""The header of every OpenIGTLink message: 58 bytes, and its time stamp."""

import re
import struct
from dataclasses import dataclass
from typing import Final

from service.pipeline.transform_names import NAME_BYTES
from service.protocols.openigtlink.errors import BadMessage

HEADER_BYTES: Final = 58
VERSIONS: Final = (1, 2)
"""Header version 1: protocol versions 1 and 2. Header version 2: protocol version 3."""
TYPE_BYTES: Final = 12

_HEADER: Final = struct.Struct(">H12s20sIIQQ")
_TYPE: Final = re.compile(rb"[!-~]+\Z")
_NS: Final = 1_000_000_000
_LAST_SECOND: Final = 2**32 - 1


@dataclass(frozen=True)
class Header:
    """What stands before a message's body.

    Args:
        version: 1 or 2.
        type: what the message is: ``TRANSFORM``, ``GET_STATUS``, ...
        device: the name that the sender gives to what it is of.
        time_ns: when that was, since 1970 [ns]; 0: not said.
        body_bytes: size of the body.
        checksum: CRC-64 of the body (ECMA-182).
    """

    version: int
    type: str
    device: str
    time_ns: int
    body_bytes: int
    checksum: int


def write_header(header: Header) -> bytes:
    """Return a header's bytes.

    Raises:
        BadMessage: a name is too long for its field, or the time does not fit.
    """
    kind, device = header.type.encode(), header.device.encode()
    if len(kind) > TYPE_BYTES or len(device) > NAME_BYTES:
        raise BadMessage(
            f'the type "{header.type}" may have {TYPE_BYTES} bytes, the name "{header.device}" '
            f"{NAME_BYTES}; they have {len(kind)} and {len(device)}"
        )
    if not 0 <= header.time_ns // _NS <= _LAST_SECOND:
        raise BadMessage(f"the time {header.time_ns} ns is not between 1970 and 2106")
    seconds, fraction = _seconds(header.time_ns)
    size, checksum = header.body_bytes, header.checksum
    return _HEADER.pack(header.version, kind, device, seconds, fraction, size, checksum)


def read_header(data: bytes) -> Header:
    """Return the header that 58 bytes are.

    Raises:
        BadMessage: they are none: an unknown version, or a type that is no name.
    """
    version, kind, device, seconds, fraction, size, checksum = _HEADER.unpack(data)
    if version not in VERSIONS:
        raise BadMessage(f"header version {version}: this is no OpenIGTLink of version 1 to 3")
    kind = kind.rstrip(b"\0 ")
    if _TYPE.match(kind) is None:
        raise BadMessage(f"message type {kind!r}: a type is a name of printable ASCII characters")
    name = device.partition(b"\0")[0].decode(errors="replace")
    return Header(version, kind.decode(), name, _time_ns(seconds, fraction), size, checksum)


def _seconds(time_ns: int) -> tuple[int, int]:
    """Return seconds and the fraction of a second in units of 2^-32 s, rounded down."""
    seconds, rest = divmod(time_ns, _NS)
    return seconds, (rest << 32) // _NS


def _time_ns(seconds: int, fraction: int) -> int:
    """Return the nearest nanosecond: of what `_seconds` made, the same one."""
    return seconds * _NS + ((fraction * _NS + 2**31) >> 32)
