"""Envelope: messages of a station's bus as one message between machines, numbered.

A header in MessagePack, and the messages' bytes behind it as they are in the station, or
compressed. The number counts what was said on the subject since the station began (its
incarnation), so that a reader counts what it missed. What is larger than the broker takes goes in
parts.
"""

import zlib
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


def pack(envelope: Envelope, limit: int, *, compressed: bool = False) -> list[bytes]:
    """Return an envelope as messages; each has the next number.

    Args:
        envelope: what goes together.
        limit: bytes of a message at most.
        compressed: with DEFLATE at its fastest: frames become a tenth, their pixels do not.
    """
    body = b"".join(envelope.messages)
    lengths = [len(message) for message in envelope.messages]
    if compressed:
        body = zlib.compress(body, 1)
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
            compressed,
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
        compressed: whether the envelope's messages are, together.
        lengths: of the envelope's messages; those of the first part.
        body: its bytes.
    """

    incarnation: str
    number: int
    sent_s: float
    index: int
    count: int
    compressed: bool
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
        incarnation, number, sent_s, index, count, compressed, lengths = members
        if not (
            isinstance(incarnation, str)
            and isinstance(number, int)
            and isinstance(sent_s, float)
            and isinstance(index, int)
            and isinstance(count, int)
            and isinstance(compressed, bool)
            and 0 <= index < count
            and all(isinstance(length, int) and length >= 0 for length in lengths)
        ):
            raise ValueError("its header is another")
    except (TypeError, ValueError, msgpack.UnpackException) as error:
        raise NotAnEnvelope(f"this is no message of the bus: {error}") from error
    body = memoryview(data)[unpacker.tell() :]
    if count == 1 and not compressed and sum(lengths) != len(body):
        raise NotAnEnvelope(f"this is no message of the bus: {len(body)} bytes of {sum(lengths)}")
    return Part(incarnation, number, sent_s, index, count, compressed, lengths, body)


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
            return missed, _messages(part.lengths, _plain(part, part.body))
        self._parts.append(part)
        if part.index < part.count - 1:
            return missed, iter(())
        first, body = self._parts[0], b"".join(one.body for one in self._parts)
        self._parts = []
        return missed, _messages(first.lengths, _plain(first, memoryview(body)))


def _plain(first: Part, body: memoryview) -> memoryview:
    """Return the bytes of an envelope's messages; raises NotAnEnvelope."""
    wanted = sum(first.lengths)
    if first.compressed:
        try:
            # No more than it says: a few bytes may stand for gigabytes.
            body = memoryview(zlib.decompressobj().decompress(body, wanted + 1))
        except zlib.error as error:
            raise NotAnEnvelope(f"this is no message of the bus: {error}") from error
    if len(body) != wanted:
        raise NotAnEnvelope(f"this is no message of the bus: {len(body)} bytes of {wanted}")
    return body


def _messages(lengths: Sequence[int], body: memoryview) -> Iterator[bytes]:
    at = 0
    for length in lengths:
        yield bytes(body[at : at + length])
        at += length
