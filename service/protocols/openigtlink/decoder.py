"""Bytes to messages, without any input or output: what came so far goes in, messages come out."""

from collections.abc import Container
from dataclasses import dataclass
from typing import Final

from service.protocols.openigtlink.errors import BadMessage
from service.protocols.openigtlink.header import HEADER_BYTES, Header, read_header
from service.protocols.openigtlink.message import Message, read_body

MAX_BODY_BYTES: Final = 1 << 20
"""Of a message that is read; none that this server understands is nearly as large."""


@dataclass(frozen=True)
class Skipped:
    """A message of a type that is not read: its body is passed over, however long."""

    header: Header


@dataclass(frozen=True)
class Damaged:
    """A message that could not be read; the next one begins where its header says."""

    header: Header
    reason: BadMessage


Event = Message | Skipped | Damaged


class Decoder:
    """Cuts a stream of bytes into messages.

    Holds no more than what was fed and not yet taken, and of one message at most
    ``max_body_bytes``.

    Args:
        known: types that are read; others are skipped.
        max_body_bytes: largest body of a type that is read.
    """

    def __init__(self, known: Container[str], max_body_bytes: int = MAX_BODY_BYTES) -> None:
        self._known = known
        self._max_body_bytes = max_body_bytes
        self._buffer = bytearray()
        self._header: Header | None = None
        self._skip = 0
        self._failed: BadMessage | None = None

    @property
    def partial(self) -> bool:
        """Whether a message has begun and its end is not there."""
        return bool(self._buffer) or self._header is not None or self._skip > 0

    @property
    def held_bytes(self) -> int:
        """What is held of messages that are not complete, or not taken."""
        return len(self._buffer)

    def feed(self, data: bytes) -> None:
        """Take bytes as they came."""
        self._buffer += data

    def take(self) -> Event | None:
        """Return the next message; None: more bytes are needed.

        Raises:
            BadMessage: what comes is no OpenIGTLink, or too large; nothing can be read after it.
        """
        if self._failed is not None:
            raise self._failed
        if not self._pass_over():
            return None
        if self._header is None:
            if len(self._buffer) < HEADER_BYTES:
                return None
            header = self._begin()
            if header.type not in self._known:
                self._skip = header.body_bytes
                self._pass_over()
                return Skipped(header)
            self._header = header
        return self._end(self._header)

    def _pass_over(self) -> bool:
        """Drop what is skipped; False while there is more of it to come."""
        here = min(self._skip, len(self._buffer))
        del self._buffer[:here]
        self._skip -= here
        return self._skip == 0

    def _begin(self) -> Header:
        try:
            header = read_header(bytes(self._buffer[:HEADER_BYTES]))
            if header.type in self._known and header.body_bytes > self._max_body_bytes:
                raise BadMessage(
                    f"{header.type} with a body of {header.body_bytes} bytes; "
                    f"{self._max_body_bytes} is "
                    "the most"
                )
        except BadMessage as error:
            self._failed = error
            self._buffer.clear()
            raise
        del self._buffer[:HEADER_BYTES]
        return header

    def _end(self, header: Header) -> Event | None:
        if len(self._buffer) < header.body_bytes:
            return None
        body = bytes(self._buffer[: header.body_bytes])
        del self._buffer[: header.body_bytes]
        self._header = None
        try:
            return read_body(header, body)
        except BadMessage as error:
            return Damaged(header, error)
