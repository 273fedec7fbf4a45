"""Contents of STATUS, STRING, COMMAND, CAPABILITY and the answers RTS_..."""

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from service.protocols.openigtlink.errors import BadMessage
from service.protocols.openigtlink.header import TYPE_BYTES
from service.protocols.openigtlink.message import decoded, encoded
from service.protocols.openigtlink.pose_bodies import read_text, truncate

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
