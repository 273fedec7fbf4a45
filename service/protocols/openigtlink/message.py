"""Message: header, content and metadata of an OpenIGTLink message, and its decoder."""

import re
import struct
from collections.abc import Container, Mapping
from dataclasses import dataclass, field
from typing import Final

from fastcrc import crc64

from compute.errors import LumilineError
from service.pipeline.transform_names import NAME_BYTES


class BadMessage(LumilineError):
    """Bytes that are no OpenIGTLink message, or content that is none of its type."""

    code = "openigtlink-bad-message"


class WrongChecksum(BadMessage):
    """A message's body does not match its checksum."""

    code = "openigtlink-wrong-checksum"


class CommandRefused(LumilineError):
    """A command that is not known, not allowed, or lacks what it needs."""

    code = "openigtlink-command-refused"


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
    """Header of a message.

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


_EXTENDED: Final = struct.Struct(">HHII")
_COUNT: Final = struct.Struct(">H")
_ENTRY: Final = struct.Struct(">HHI")

ASCII: Final = 3
UTF8: Final = 106
"""Character encodings by their MIBenum of IANA."""
_ENCODINGS: Final = {ASCII: "ascii", UTF8: "utf-8"}


@dataclass(frozen=True)
class Message:
    """One message.

    Args:
        type: what it is.
        device: what it is of; at most 20 bytes.
        content: as its type says.
        time_ns: when that was [ns]; 0: not said.
        version: of the header; 1 has no metadata and no number.
        metadata: names and values.
        number: by which an answer is told to be one, 0 to 2^32 - 1.
    """

    type: str
    device: str = ""
    content: bytes = b""
    time_ns: int = 0
    version: int = 1
    metadata: Mapping[str, str] = field(default_factory=dict)
    number: int = 0


def write_message(message: Message) -> bytes:
    """Return a message's bytes; version 1 leaves metadata and number out.

    Raises:
        BadMessage: a name, a value or the time is too long for its field.
    """
    kind, device = message.type.encode(), message.device.encode()
    if len(kind) > TYPE_BYTES or len(device) > NAME_BYTES:
        raise BadMessage(
            f'the type "{message.type}" may have {TYPE_BYTES} bytes, the name "{message.device}" '
            f"{NAME_BYTES}; they have {len(kind)} and {len(device)}"
        )
    if not 0 <= message.time_ns // _NS <= _LAST_SECOND:
        raise BadMessage(f"the time {message.time_ns} ns is not between 1970 and 2106")
    body = message.content
    if message.version > 1:
        head, values = _write_metadata(message.metadata)
        extended = _EXTENDED.pack(_EXTENDED.size, len(head), len(values), message.number)
        body = b"".join((extended, body, head, values))
    time = _seconds(message.time_ns)
    checksum = crc64.ecma_182(body)
    return _HEADER.pack(message.version, kind, device, *time, len(body), checksum) + body


def read_body(header: Header, body: bytes) -> Message:
    """Return the message of a header and its body.

    Raises:
        WrongChecksum: the body is damaged.
        BadMessage: its parts do not fit in it.
    """
    checksum = crc64.ecma_182(body)
    if checksum != header.checksum:
        raise WrongChecksum(
            f"{header.type}: the checksum of the body is {checksum:016x}, the header says "
            f"{header.checksum:016x}"
        )
    if header.version == 1:
        return Message(header.type, header.device, body, header.time_ns)
    if len(body) < _EXTENDED.size:
        raise BadMessage(f"{header.type}: no room for the extended header in {len(body)} bytes")
    extended, head, values, number = _EXTENDED.unpack_from(body)
    end = len(body) - head - values
    if extended < _EXTENDED.size or extended > end:
        raise BadMessage(
            f"{header.type}: an extended header of {extended} bytes and metadata of {head} and "
            f"{values} do not fit in a body of {len(body)}"
        )
    metadata = _read_metadata(header.type, body[end : end + head], body[end + head :])
    content = body[extended:end]
    return Message(header.type, header.device, content, header.time_ns, 2, metadata, number)


def encoded(text: str) -> tuple[int, bytes]:
    """Return the encoding's number and the text in it: ASCII where that is enough."""
    return (ASCII, text.encode()) if text.isascii() else (UTF8, text.encode())


def decoded(encoding: int, text: bytes) -> str:
    """Return a text.

    Raises:
        BadMessage: the encoding is another than ASCII and UTF-8, or the bytes are not in it.
    """
    name = _ENCODINGS.get(encoding)
    if name is None:
        raise BadMessage(f"character encoding {encoding}; 3 (ASCII) and 106 (UTF-8) are understood")
    try:
        return text.decode(name)
    except UnicodeDecodeError:
        raise BadMessage(f"a text is not in the encoding {name} that it says") from None


def _write_metadata(metadata: Mapping[str, str]) -> tuple[bytes, bytes]:
    headers: list[bytes] = []
    values: list[bytes] = []
    for name, value in metadata.items():
        key = name.encode()
        encoding, text = encoded(value)
        try:
            headers.append(_ENTRY.pack(len(key), encoding, len(text)))
        except struct.error:
            raise BadMessage(f"metadata: a name of {len(key)} bytes; 65535 fit") from None
        values += (key, text)
    head = _COUNT.pack(len(headers)) + b"".join(headers) if len(headers) < 2**13 - 1 else b""
    if not head:
        raise BadMessage(f"{len(headers)} metadata; a message has room for {2**13 - 2}")
    return head, b"".join(values)


def _read_metadata(kind: str, head: bytes, values: bytes) -> dict[str, str]:
    if not head:
        return {}
    if len(head) < _COUNT.size:
        raise BadMessage(f"{kind}: a metadata header of {len(head)} bytes")
    (count,) = _COUNT.unpack_from(head)
    if len(head) != _COUNT.size + count * _ENTRY.size:
        raise BadMessage(f"{kind}: {count} metadata do not make a header of {len(head)} bytes")
    metadata, at = {}, 0
    for key_bytes, encoding, value_bytes in _ENTRY.iter_unpack(head[_COUNT.size :]):
        if at + key_bytes + value_bytes > len(values):
            raise BadMessage(f"{kind}: metadata of {len(values)} bytes end too early")
        key = decoded(UTF8, values[at : at + key_bytes])
        at += key_bytes
        metadata[key] = decoded(encoding, values[at : at + value_bytes])
        at += value_bytes
    return metadata


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
    """

    def __init__(self, known_types: Container[str], max_body_bytes: int = MAX_BODY_BYTES) -> None:
        self._known_types = known_types
        self._max_body_bytes = max_body_bytes
        self._buffer = bytearray()
        self._header: Header | None = None
        self._skip = 0
        self._failed: BadMessage | None = None

    @property
    def partial(self) -> bool:
        """Whether a message has begun and its end is not there."""
        return bool(self._buffer) or self._header is not None or self._skip > 0

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
            if header.type not in self._known_types:
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
            if header.type in self._known_types and header.body_bytes > self._max_body_bytes:
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
