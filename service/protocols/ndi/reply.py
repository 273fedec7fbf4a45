"""Replies of the common API, as text and as binary records, with their checksums."""

import struct
from typing import Final

from fastcrc import crc16

from service.protocols.ndi.errors import ErrorCode

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
