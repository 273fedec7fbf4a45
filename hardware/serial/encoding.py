"""Reference encoder of the serial protocol (docs/reference/serial-protocol.md)."""

import struct
import zlib
from functools import singledispatch
from typing import Final

import numpy as np
from cobs import cobs

from compute.errors import InvalidParameter
from hardware.serial.messages import (
    MAX_BYTES,
    MAX_NAME_BYTES,
    VERSION,
    Answer,
    Describe,
    Description,
    DeviceStatus,
    Exposure,
    Lines,
    Message,
    MessageType,
    Start,
    Stop,
    Strobe,
)

DESCRIPTION: Final = struct.Struct("<BBBBHBBI8f")
LINES: Final = struct.Struct("<BBIQII")
STATUS: Final = struct.Struct("<HQfII")
ANSWER: Final = struct.Struct("<BBH")
NUMBER: Final = struct.Struct("<H")
EXPOSURE: Final = struct.Struct("<Hff")
CRC: Final = struct.Struct("<I")
HEAD: Final = struct.Struct("<BB")


def encode(message: Message) -> bytes:
    """Return the encoded bytes of a message, with the terminating zero.

    Raises:
        InvalidParameter: a value has no room in its field, or the whole is longer than
            MAX_BYTES.
    """
    try:
        kind, body = _body(message)
    except (struct.error, OverflowError) as error:
        raise InvalidParameter(
            f"{message} has a value without room in its field: {error}"
        ) from error
    content = HEAD.pack(VERSION, kind) + body
    line: bytes = cobs.encode(content + CRC.pack(zlib.crc32(content))) + b"\0"
    if len(line) > MAX_BYTES:
        raise InvalidParameter(
            f"the message is {len(line)} bytes long; it may have {MAX_BYTES}: send its lines in "
            "parts",
            bytes=len(line),
        )
    return line


def split_lines(message: Lines, counts: int) -> list[Lines]:
    """Split an exposure's counts into several messages, as a small device sends them."""
    return [
        Lines(
            message.sequence,
            message.ticks,
            message.marker,
            message.flags,
            message.lost,
            message.first + start,
            message.counts[start : start + counts],
        )
        for start in range(0, len(message.counts), counts)
    ]


@singledispatch
def _body(message: Message) -> tuple[MessageType, bytes]:
    """Return a message's type and body."""
    raise TypeError(f"{type(message).__name__} is no message of the protocol")


@_body.register
def _(message: Description) -> tuple[MessageType, bytes]:
    fixed = DESCRIPTION.pack(
        message.abilities,
        message.bits,
        len(message.sensors),
        message.markers,
        message.pixels,
        message.clock_bits,
        0,
        message.clock_hz,
        message.pitch_um,
        message.electrons_per_count,
        message.read_noise_electrons,
        message.offset_counts,
        message.frame_rate_hz,
        message.exposure_us,
        message.delay_us,
        message.line_sigma_px,
    )
    names = b"".join(_name(name) for name in (message.name, *message.sensors))
    return MessageType.DESCRIPTION, fixed + names


def _name(text: str) -> bytes:
    encoded = text.encode()
    if not 1 <= len(encoded) <= MAX_NAME_BYTES:
        raise InvalidParameter(
            f"the name {text!r} has {len(encoded)} bytes; it must have 1 to {MAX_NAME_BYTES}"
        )
    return bytes([len(encoded)]) + encoded


@_body.register
def _(message: Lines) -> tuple[MessageType, bytes]:
    head = LINES.pack(
        message.marker,
        message.flags,
        message.sequence,
        message.ticks,
        message.lost,
        message.first,
    )
    return MessageType.LINES, head + np.ascontiguousarray(message.counts, dtype="<u2").tobytes()


@_body.register
def _(message: DeviceStatus) -> tuple[MessageType, bytes]:
    return MessageType.STATUS, STATUS.pack(
        0, message.ticks, message.temperature_c, message.lost, message.garbled
    )


@_body.register
def _(message: Answer) -> tuple[MessageType, bytes]:
    return MessageType.ANSWER, ANSWER.pack(message.command, message.result, message.number)


@_body.register
def _(message: Describe) -> tuple[MessageType, bytes]:
    return MessageType.DESCRIBE, NUMBER.pack(message.number)


@_body.register
def _(message: Start) -> tuple[MessageType, bytes]:
    return MessageType.START, NUMBER.pack(message.number)


@_body.register
def _(message: Stop) -> tuple[MessageType, bytes]:
    return MessageType.STOP, NUMBER.pack(message.number)


@_body.register
def _(message: Exposure) -> tuple[MessageType, bytes]:
    return MessageType.EXPOSURE, EXPOSURE.pack(
        message.number, message.frame_rate_hz, message.exposure_us
    )


@_body.register
def _(message: Strobe) -> tuple[MessageType, bytes]:
    slots = struct.pack(f"<B{len(message.slots)}B", len(message.slots), *message.slots)
    return MessageType.STROBE, NUMBER.pack(message.number) + slots
