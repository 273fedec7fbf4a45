"""CommandReader: commands of the common API, read from a stream of bytes."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from fastcrc import crc16

from service.protocols.ndi.errors import CommandError, ErrorCode

MAX_BYTES: Final = 2048
"""Longest command, its checksum included: ECHO's is the longest that is of use."""

_FORM: Final = re.compile(rb"([A-Za-z0-9]+)(?:([: ])(.*))?", re.DOTALL)
_HEX4: Final = re.compile(rb"[0-9A-Fa-f]{4}")


@dataclass(frozen=True)
class Command:
    """A whole command.

    Args:
        name: in upper case, as ``TX``.
        text: its parameters, without the checksum.
    """

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
        Refused: it is empty, no command at all, or the checksum is another.
    """
    line = line.removeprefix(b"\n")
    if not line:
        raise CommandError(ErrorCode.TOO_SHORT)
    found = _FORM.fullmatch(line)
    if found is None or not line.isascii():
        raise CommandError(ErrorCode.INVALID_COMMAND)
    name, separator, rest = found.groups()
    if separator == b":":
        if len(rest) < 4:
            raise CommandError(ErrorCode.TOO_SHORT)
        if _HEX4.fullmatch(rest[-4:]) is None or int(rest[-4:], 16) != crc16.arc(line[:-4]):
            raise CommandError(ErrorCode.BAD_CRC)
        rest = rest[:-4]
    return Command(name.decode().upper(), (rest or b"").decode())
