"""Envelope: messages of a station's bus as one message between machines, numbered.

A header in MessagePack, and the messages' bytes behind it as they are in the station. The number
counts what was said on the subject since the station began (its incarnation), so that a reader
counts what it missed. What is larger than the broker takes goes in parts.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import msgpack

VERSION: Final = 1
ROOM: Final = 256
"""Bytes that are left for the header of a message."""


class NotAnEnvelope(ValueError):
    """The bytes are no message of this version of the bus."""


@dataclass(frozen=True)
class Envelope:
    """Messages that go together.

    Args:
        incarnation: of the station: another for each time that its process began.
        number: of the first part on its subject, from 0.
        sent_s: when it was sent, by ``time.monotonic`` of the station's machine [s].
        messages: of the bus, in order.
    """

    incarnation: str
    number: int
    sent_s: float
    messages: tuple[bytes, ...]


def pack(envelope: Envelope, limit: int) -> list[bytes]:
    """Return an envelope as messages of at most so many bytes; each has the next number."""
    body = b"".join(envelope.messages)
    lengths = [len(message) for message in envelope.messages]
    room = limit - ROOM - 5 * len(lengths)
    if room < 1:
        raise ValueError(f"a broker's messages of {limit} bytes are too small for the bus")
    parts = [body[at : at + room] for at in range(0, len(body), room)] or [b""]
    packed = []
    for index, part in enumerate(parts):
        header = (
            VERSION,
            envelope.incarnation,
            envelope.number + index,
            envelope.sent_s,
            index,
            len(parts),
            lengths if index == 0 else (),
        )
        packed.append(msgpack.packb(header) + part)
    return packed


@dataclass(frozen=True)
class Part:
    """A message between machines.

    Args:
        incarnation: of the station.
        number: on its subject.
        sent_s: when it was sent, by the station's clock [s].
        index: which part of an envelope it is.
        count: of how many.
        lengths: of the envelope's messages; those of the first part.
        body: its bytes.
    """

    incarnation: str
    number: int
    sent_s: float
    index: int
    count: int
    lengths: Sequence[int]
    body: memoryview


def unpack(data: bytes) -> Part:
    """Return a message between machines.

    Raises:
        NotAnEnvelope: it is none.
    """
    unpacker = msgpack.Unpacker(max_buffer_size=len(data) or 1)
    unpacker.feed(data)
    try:
        version, *members = unpacker.unpack()
        if version != VERSION:
            raise ValueError(f"it is of version {version}")
        incarnation, number, sent_s, index, count, lengths = members
        if not (
            isinstance(incarnation, str)
            and isinstance(number, int)
            and isinstance(sent_s, float)
            and isinstance(index, int)
            and isinstance(count, int)
            and 0 <= index < count
            and all(isinstance(length, int) and length >= 0 for length in lengths)
        ):
            raise ValueError("its header is another")
    except (TypeError, ValueError, msgpack.UnpackException) as error:
        raise NotAnEnvelope(f"this is no message of the bus: {error}") from error
    body = memoryview(data)[unpacker.tell() :]
    if count == 1 and sum(lengths) != len(body):
        raise NotAnEnvelope(f"this is no message of the bus: {len(body)} bytes of {sum(lengths)}")
    return Part(incarnation, number, sent_s, index, count, lengths, body)


class Reassembly:
    """Puts the messages of one subject together again, and counts those that are missing."""

    def __init__(self) -> None:
        self.incarnation: str | None = None
        """Of the newest message."""
        self.number = -1
        """Of the newest message."""
        self._parts: list[Part] = []

    def take(self, part: Part) -> tuple[int, Iterator[bytes]]:
        """Take a message; return how many are missing before it, and the messages in it.

        There are none in a part that is not the last. Those before the first that is ever taken are
        not missing.
        """
        missed = 0
        if part.incarnation != self.incarnation:
            self.incarnation, self._parts = part.incarnation, []
        else:
            missed = max(0, part.number - self.number - 1)
        self.number = part.number
        if missed:
            self._parts = []
        if part.index != len(self._parts):
            self._parts = []
            # Of an envelope whose begin is missing.
            return missed, iter(())
        if part.count == 1:
            return missed, _messages(part.lengths, part.body)
        self._parts.append(part)
        if part.index < part.count - 1:
            return missed, iter(())
        body = memoryview(b"".join(one.body for one in self._parts))
        lengths, self._parts = self._parts[0].lengths, []
        if sum(lengths) != len(body):
            return missed + 1, iter(())
        return missed, _messages(lengths, body)


def _messages(lengths: Sequence[int], body: memoryview) -> Iterator[bytes]:
    at = 0
    for length in lengths:
        yield bytes(body[at : at + length])
        at += length
