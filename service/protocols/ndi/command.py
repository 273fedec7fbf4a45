"""Commands of the common API, read from a stream of bytes; replies, error codes, checksums."""

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from enum import STRICT, IntEnum, IntFlag
from string import hexdigits
from typing import Final

from fastcrc import crc16


class ErrorCode(IntEnum):
    """Error codes, in hexadecimal digits behind ``ERROR`` in a reply."""

    INVALID_COMMAND = 0x01
    TOO_LONG = 0x02
    TOO_SHORT = 0x03
    BAD_CRC = 0x04
    WRONG_PARAMETERS = 0x07
    INVALID_HANDLE = 0x08
    INVALID_PRIORITY = 0x09
    INVALID_LED = 0x0A
    INVALID_LED_STATE = 0x0B
    INVALID_IN_THIS_MODE = 0x0C
    NO_TOOL = 0x0D
    NOT_INITIALISED_HANDLE = 0x0E
    NOT_INITIALISED = 0x10
    CANNOT_INITIALISE = 0x15
    OUT_OF_RANGE = 0x23
    NOT_ALLOCATED = 0x2B
    ALL_ALLOCATED = 0x2D
    NO_SUCH_FEATURE = 0x33
    NO_SUCH_PARAMETER = 0x34
    WRONG_VALUE_TYPE = 0x35
    VALUE_OUT_OF_RANGE = 0x36
    READ_ONLY = 0x39


class CommandError(Exception):
    """A command is not carried out; its reply is the error."""

    def __init__(self, code: ErrorCode) -> None:
        super().__init__(code.name)
        self.code = code


def require(fulfilled: bool, code: ErrorCode) -> None:
    """Raise CommandError where a condition is not fulfilled."""
    if not fulfilled:
        raise CommandError(code)


class ReplyOption(IntFlag, boundary=STRICT):
    """Bits of the parameter of TX and BX."""

    TRANSFORMS = 0x0001
    INFORMATION = 0x0002
    SINGLE_STRAY = 0x0004
    MARKERS = 0x0008
    OUT_OF_VOLUME = 0x0800
    STRAYS = 0x1000


def reply_option(text: str) -> ReplyOption:
    """Return the options of a command's text; without any, transforms.

    Raises:
        CommandError: they are no four hexadecimal digits, or there are bits that mean nothing.
    """
    if not text:
        return ReplyOption.TRANSFORMS
    try:
        return ReplyOption(hexadecimal(text, 4))
    except ValueError:
        raise CommandError(ErrorCode.OUT_OF_RANGE) from None


def hexadecimal(text: str, digits: int) -> int:
    """Return the value of hexadecimal digits; raises CommandError."""
    require(len(text) == digits, ErrorCode.WRONG_PARAMETERS)
    require(all(one in hexdigits for one in text), ErrorCode.OUT_OF_RANGE)
    return int(text, 16)


MAX_BYTES: Final = 2048
"""Longest command, its checksum included: ECHO's is the longest that is of use."""

_FORM: Final = re.compile(rb"([A-Za-z0-9]+)(?:([: ])(.*))?", re.DOTALL)
_HEX4: Final = re.compile(rb"[0-9A-Fa-f]{4}")


@dataclass(frozen=True)
class Command:
    """A whole command."""

    name: str
    text: str


class Break:
    """A serial break, which arrives as NUL bytes: the client wants a reset."""


BREAK: Final = Break()

Received = Command | Break | ErrorCode
"""What came: a command, a break, or what is wrong with a line that is neither."""


class CommandReader:
    """Splits a stream of bytes at its carriage returns.

    Whatever comes, it raises nothing, keeps at most MAX_BYTES, and begins afresh behind the next
    carriage return.
    """

    def __init__(self) -> None:
        self._line = bytearray()
        self._too_long = False
        self._in_break = False

    def feed(self, data: bytes) -> Iterator[Received]:
        """Yield what these bytes complete; a break throws away what came before it."""
        for part in re.split(rb"(\r|\x00+)", data):
            if not part:
                continue
            if part[0] == 0:
                if not self._in_break:
                    yield BREAK
                self._in_break = True
                self._begin()
                continue
            self._in_break = False
            if part != b"\r":
                self._keep(part)
                continue
            line, too_long = bytes(self._line), self._too_long
            self._begin()
            if too_long:
                yield ErrorCode.TOO_LONG
                continue
            try:
                yield parse(line)
            except CommandError as refused:
                yield refused.code

    def _begin(self) -> None:
        self._line.clear()
        self._too_long = False

    def _keep(self, part: bytes) -> None:
        if self._too_long or len(self._line) + len(part) > MAX_BYTES:
            self._too_long = True
            self._line.clear()
        else:
            self._line += part


def parse(line: bytes) -> Command:
    """Return the command in a line without its carriage return.

    ``NAME`` and ``NAME PARAMETERS`` have no checksum, ``NAME:PARAMETERSXXXX`` has one, of all that
    is before it. A line feed at the beginning is left over from who ends lines with two bytes.

    Raises:
        CommandError: it is empty, no command at all, or the checksum is another.
    """
    line = line.removeprefix(b"\n")
    if not line:
        raise CommandError(ErrorCode.TOO_SHORT)
    match = _FORM.fullmatch(line)
    if match is None or not line.isascii():
        raise CommandError(ErrorCode.INVALID_COMMAND)
    name, separator, rest = match.groups()
    if separator == b":":
        if len(rest) < 4:
            raise CommandError(ErrorCode.TOO_SHORT)
        if _HEX4.fullmatch(rest[-4:]) is None or int(rest[-4:], 16) != crc16.arc(line[:-4]):
            raise CommandError(ErrorCode.BAD_CRC)
        rest = rest[:-4]
    return Command(name.decode().upper(), (rest or b"").decode())


START: Final = 0xA5C4
"""How a binary reply begins, little-endian."""

OKAY: Final = "OKAY"
RESET: Final = "RESET"


def text_reply(text: str) -> bytes:
    """Return a reply of ASCII characters: with its checksum, and a carriage return."""
    body = text.encode("ascii", "replace")
    return body + b"%04X\r" % crc16.arc(body)


def error_reply(code: ErrorCode) -> bytes:
    """Return the reply to a command that is refused."""
    return text_reply(f"ERROR{code:02X}")


def binary_reply(body: bytes) -> bytes:
    """Return a reply of binary data: start and length with a checksum, the data with another.

    A driver may as well check the last one over the whole reply: a record that is followed by its
    own checksum leaves this checksum at 0.
    """
    head = struct.pack("<HH", START, len(body))
    return head + struct.pack("<H", crc16.arc(head)) + body + struct.pack("<H", crc16.arc(body))
