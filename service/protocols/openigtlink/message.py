"""Message: header, content and metadata (header version 2) of an OpenIGTLink message."""

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from fastcrc import crc64

from service.protocols.openigtlink.errors import BadMessage, WrongChecksum
from service.protocols.openigtlink.header import Header, write_header

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
    body = message.content
    if message.version > 1:
        head, values = _write_metadata(message.metadata)
        extended = _EXTENDED.pack(_EXTENDED.size, len(head), len(values), message.number)
        body = b"".join((extended, body, head, values))
    header = Header(
        message.version,
        message.type,
        message.device,
        message.time_ns,
        len(body),
        crc64.ecma_182(body),
    )
    return write_header(header) + body


def read_body(header: Header, body: bytes) -> Message:
    """Return the message of a header and its body.

    Raises:
        WrongChecksum: the body is damaged.
        BadMessage: its parts do not fit in it.
    """
    found = crc64.ecma_182(body)
    if found != header.checksum:
        raise WrongChecksum(
            f"{header.type}: the checksum of the body is {found:016x}, the header says "
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
    heads: list[bytes] = []
    values: list[bytes] = []
    for name, value in metadata.items():
        key = name.encode()
        encoding, text = encoded(value)
        try:
            heads.append(_ENTRY.pack(len(key), encoding, len(text)))
        except struct.error:
            raise BadMessage(f"metadata: a name of {len(key)} bytes; 65535 fit") from None
        values += (key, text)
    head = _COUNT.pack(len(heads)) + b"".join(heads) if len(heads) < 2**13 - 1 else b""
    if not head:
        raise BadMessage(f"{len(heads)} metadata; a message has room for {2**13 - 2}")
    return head, b"".join(values)


def _read_metadata(kind: str, head: bytes, values: bytes) -> dict[str, str]:
    if not head:
        return {}
    if len(head) < _COUNT.size:
        raise BadMessage(f"{kind}: a metadata header of {len(head)} bytes")
    (count,) = _COUNT.unpack_from(head)
    if len(head) != _COUNT.size + count * _ENTRY.size:
        raise BadMessage(f"{kind}: {count} metadata do not make a header of {len(head)} bytes")
    found, at = {}, 0
    for key_bytes, encoding, value_bytes in _ENTRY.iter_unpack(head[_COUNT.size :]):
        if at + key_bytes + value_bytes > len(values):
            raise BadMessage(f"{kind}: metadata of {len(values)} bytes end too early")
        key = decoded(UTF8, values[at : at + key_bytes])
        at += key_bytes
        found[key] = decoded(encoding, values[at : at + value_bytes])
        at += value_bytes
    return found
