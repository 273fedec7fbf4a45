"""Stream decoder of the serial protocol: COBS framing, CRC-32, resynchronisation."""

import zlib
from dataclasses import dataclass
from typing import Final

from cobs import cobs

from hardware.serial.codec import CRC, HEAD, MalformedMessage, parse
from hardware.serial.messages import MAX_BYTES, VERSION, Message

_MIN_BYTES: Final = HEAD.size + CRC.size


@dataclass
class DecoderCounters:
    """Counters of decoded and discarded messages.

    Args:
        bytes_received: all bytes.
        messages: valid messages of known types.
        garbled: invalid COBS or wrong checksum: damaged, truncated, or not a message.
        too_long: longer than MAX_BYTES.
        wrong_version: intact, of another version of the protocol.
        unknown: intact, of an unknown type.
        malformed: intact, with invalid content.
    """

    bytes_received: int = 0
    messages: int = 0
    garbled: int = 0
    too_long: int = 0
    wrong_version: int = 0
    unknown: int = 0
    malformed: int = 0

    @property
    def discarded(self) -> int:
        """Number of unusable messages; unknown types, meant for newer hosts, do not count."""
        return self.garbled + self.too_long + self.wrong_version + self.malformed


class Decoder:
    """Splits a byte stream at zeros and decodes the messages between them.

    It never raises on input, keeps at most ``max_bytes`` of an unfinished message, and
    resynchronises at the next zero. Bytes before the first zero after ``reset`` are not counted
    as garbled: the host began to listen in the middle of a message.

    Attributes:
        complaint: error message of the last intact but unusable message; None: there was none
            since ``reset``.
    """

    def __init__(self, max_bytes: int = MAX_BYTES) -> None:
        self.counters = DecoderCounters()
        self.complaint: str | None = None
        self._max_bytes = max_bytes
        self._tail = bytearray()
        self._skipping = False
        self._first = True

    def reset(self) -> None:
        """Discard an unfinished message; keep the counters."""
        self._tail.clear()
        self._skipping = False
        self._first = True
        self.complaint = None

    @property
    def pending(self) -> int:
        """Number of buffered bytes of an unfinished message."""
        return len(self._tail)

    def feed(self, data: bytes) -> list[Message]:
        """Decode received bytes; return the messages that they complete."""
        self.counters.bytes_received += len(data)
        *ends, rest = data.split(b"\0")
        messages: list[Message] = []
        for end in ends:
            line = end
            if self._tail or self._skipping:
                line = self._finished(end)
            if line:
                message = self._decode(line)
                if message is not None:
                    messages.append(message)
            self._first = False
        self._keep(rest)
        self.counters.messages += len(messages)
        return messages

    def _finished(self, end: bytes) -> bytes:
        """Return the message that ends with ``end``; empty where it is too long."""
        skipping, self._skipping = self._skipping, False
        if skipping:
            return b""
        self._tail += end
        line = bytes(self._tail)
        self._tail.clear()
        return line

    def _keep(self, rest: bytes) -> None:
        if self._skipping:
            return
        if len(self._tail) + len(rest) > self._max_bytes:
            self._tail.clear()
            self._skipping = True
            self.counters.too_long += 1
        else:
            self._tail += rest

    def _decode(self, line: bytes) -> Message | None:
        if len(line) > self._max_bytes:
            self.counters.too_long += 1
            return None
        try:
            content: bytes = cobs.decode(line)
        except cobs.DecodeError:
            content = b""
        if len(content) < _MIN_BYTES or _crc32(content) != _RESIDUE:
            self.counters.garbled += not self._first
            return None
        if content[0] != VERSION:
            self.counters.wrong_version += 1
            self.complaint = (
                f"a message came of version {content[0]} of the protocol; this is version {VERSION}"
            )
            return None
        try:
            message = parse(content[: -CRC.size])
        except MalformedMessage as error:
            self.counters.malformed += 1
            self.complaint = str(error)
            return None
        if message is None:
            self.counters.unknown += 1
        return message


def _crc32(content: bytes) -> int:
    """Return the CRC-32, without handing the interpreter to another thread meanwhile.

    zlib does so for more than 5 KiB, and to have it back takes longer than the sum itself.
    """
    view, crc = memoryview(content), 0
    for at in range(0, len(view), _CRC_BYTES):
        crc = zlib.crc32(view[at : at + _CRC_BYTES], crc)
    return crc


_CRC_BYTES: Final = 5 * 1024
_RESIDUE: Final = 0x2144DF1C
"""The CRC-32 of any content followed by its own CRC-32, least significant byte first."""
