"""Reference encoder and parser of the serial protocol (docs/reference/serial-protocol.md)."""

import math
import struct
import zlib
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from cobs import cobs

from compute.errors import InvalidParameter
from hardware.serial.messages import (
    MAX_BYTES,
    MAX_NAME_BYTES,
    MAX_PIXELS,
    MAX_SENSORS,
    MAX_VALUE,
    NO_MARKER,
    VERSION,
    Ability,
    Answer,
    Describe,
    Description,
    DeviceStatus,
    Exposure,
    Lines,
    LinesFlag,
    Message,
    MessageType,
    Start,
    Stop,
    Strobe,
)
from hardware.strobe_schedule import MAX_MARKERS

HEAD: Final = struct.Struct("<BB")
CRC: Final = struct.Struct("<I")

_LINES: Final = struct.Struct("<BBIQII")
_COUNT: Final = np.dtype("<u2")
_COUNTS: Final = HEAD.size + _LINES.size
_FLAGS: Final = tuple(LinesFlag(value & LinesFlag.SATURATED) for value in range(256))
_NUMBER: Final = struct.Struct("<H")

_FIXED_LAYOUTS: Final[dict[MessageType, tuple[type[Message], struct.Struct, tuple[str, ...]]]] = {
    MessageType.STATUS: (
        DeviceStatus, struct.Struct("<2xQfII"), ("ticks", "temperature_c", "lost", "garbled")
    ),
    MessageType.ANSWER: (Answer, struct.Struct("<BBH"), ("command", "result", "number")),
    MessageType.DESCRIBE: (Describe, _NUMBER, ("number",)),
    MessageType.START: (Start, _NUMBER, ("number",)),
    MessageType.STOP: (Stop, _NUMBER, ("number",)),
    MessageType.EXPOSURE: (
        Exposure, struct.Struct("<Hff"), ("number", "frame_rate_hz", "exposure_us")
    ),
}  # fmt: skip
"""Messages of fixed length: class, layout of the body, members in its order."""
_FIXED_TYPES: Final = {layout[0]: kind for kind, layout in _FIXED_LAYOUTS.items()}


class _Bounded(NamedTuple):
    """Member of a description: name, noun for messages, and range; above 0 from _TINY on."""

    name: str
    noun: str
    low: float
    high: float


_TINY: Final = math.ulp(0.0)
_DESCRIPTION: Final = struct.Struct("<BBBBHBxI8f")
_DESCRIBED: Final = (
    _Bounded("abilities", "abilities", 0, 255),
    _Bounded("bits", "number of bits of the conversion", 1, 16),
    _Bounded("sensors", "number of sensors", 1, MAX_SENSORS),
    _Bounded("markers", "number of markers", 0, MAX_MARKERS),
    _Bounded("pixels", "number of pixels", 1, MAX_PIXELS),
    _Bounded("clock_bits", "number of bits of the clock", 16, 64),
    _Bounded("clock_hz", "clock rate", 1, math.inf),
    _Bounded("pitch_um", "pixel pitch", _TINY, MAX_VALUE),
    _Bounded("electrons_per_count", "gain", _TINY, MAX_VALUE),
    _Bounded("read_noise_electrons", "read noise", 0.0, MAX_VALUE),
    _Bounded("offset_counts", "offset", -MAX_VALUE, MAX_VALUE),
    _Bounded("frame_rate_hz", "frame rate", 0.0, 1e6),
    _Bounded("exposure_us", "exposure time", 0.0, MAX_VALUE),
    _Bounded("delay_us", "delay", 0.0, MAX_VALUE),
    _Bounded("line_sigma_px", "line width", 0.0, MAX_VALUE),
)
"""Members of a description in the order of _DESCRIPTION; names follow."""
_ABILITIES: Final = int(Ability.START_STOP | Ability.EXPOSURE | Ability.STROBE)


class MalformedMessage(Exception):
    """Invalid content despite a correct checksum."""


def encode(message: Message) -> bytes:
    """Return the encoded bytes of a message, with the terminating zero.

    Raises:
        InvalidParameter: a value has no room in its field, or the whole is longer than
            MAX_BYTES.
    """
    try:
        kind, body = _body(message)
    except (struct.error, OverflowError, ValueError) as error:
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
        replace(message, first=message.first + at, counts=message.counts[at : at + counts])
        for at in range(0, len(message.counts), counts)
    ]


def parse(content: bytes) -> Message | None:
    """Return the message of a content without its checksum; None: unknown type.

    Raises:
        MalformedMessage: it is not as long as it should be, or a value is out of its bounds.
    """
    kind = content[1]
    if kind == MessageType.LINES:
        return _parse_lines(content)
    if kind not in _KINDS:
        return None
    body = content[HEAD.size :]
    try:
        if kind == MessageType.DESCRIPTION:
            return _parse_description(body)
        if kind == MessageType.STROBE:
            return _parse_strobe(body)
        message_type, layout, names = _FIXED_LAYOUTS[MessageType(kind)]
        message = message_type(**dict(zip(names, layout.unpack_from(body), strict=True)))
    except (struct.error, IndexError) as error:
        name = MessageType(kind).name.lower()
        raise MalformedMessage(f"a message {name} came that ends too early ({error})") from error
    if isinstance(message, Exposure):
        rate, exposure = message.frame_rate_hz, message.exposure_us
        if not (0.0 <= rate < math.inf and 0.0 <= exposure < math.inf):
            raise MalformedMessage(
                f"a command came with {rate} Hz and an exposure of {exposure} us"
            )
    return message


_KINDS: Final = frozenset(MessageType)


def _body(message: Message) -> tuple[MessageType, bytes]:
    """Return a message's type and body."""
    if isinstance(message, Lines):
        head = _LINES.pack(
            message.marker,
            message.flags,
            message.sequence,
            message.ticks,
            message.lost,
            message.first,
        )
        return MessageType.LINES, head + np.ascontiguousarray(message.counts, _COUNT).tobytes()
    if isinstance(message, Description):
        values = {**vars(message), "sensors": len(message.sensors)}
        fixed = _DESCRIPTION.pack(*(values[member.name] for member in _DESCRIBED))
        names = b"".join(_name(name) for name in (message.name, *message.sensors))
        return MessageType.DESCRIPTION, fixed + names
    if isinstance(message, Strobe):
        slots = bytes([len(message.slots), *message.slots])
        return MessageType.STROBE, _NUMBER.pack(message.number) + slots
    kind = _FIXED_TYPES.get(type(message))
    if kind is None:
        raise TypeError(f"{type(message).__name__} is no message of the protocol")
    _, layout, members = _FIXED_LAYOUTS[kind]
    return kind, layout.pack(*(getattr(message, name) for name in members))


def _name(text: str) -> bytes:
    encoded = text.encode()
    if not 1 <= len(encoded) <= MAX_NAME_BYTES:
        raise InvalidParameter(
            f"the name {text!r} has {len(encoded)} bytes; it must have 1 to {MAX_NAME_BYTES}"
        )
    return bytes([len(encoded)]) + encoded


def _parse_lines(content: bytes) -> Lines:
    if len(content) < _COUNTS + 2 or len(content) % 2:
        raise MalformedMessage(f"lines came in a message of {len(content)} bytes")
    marker, flags, sequence, ticks, lost, first = _LINES.unpack_from(content, HEAD.size)
    counts = np.frombuffer(content, _COUNT, offset=_COUNTS)
    return Lines(sequence, ticks, marker, _FLAGS[flags], lost, first, counts)


def _parse_description(body: bytes) -> Description:
    unpacked = _DESCRIPTION.unpack_from(body)
    values = {member.name: value for member, value in zip(_DESCRIBED, unpacked, strict=True)}
    sensors = values["sensors"]
    name, *names = _parse_names(body[_DESCRIPTION.size :], 1 + sensors)
    for member in _DESCRIBED:
        value = values[member.name]
        if not member.low <= value <= member.high:
            right = "above 0" if member.low == _TINY else f"{member.low:g} to {member.high:g}"
            raise MalformedMessage(
                f"a description came with {member.noun} {value:g}; it must be {right}"
            )
    if len(set(names)) < sensors:
        raise MalformedMessage(f"a description came with sensors of one name: {', '.join(names)}")
    values["sensors"], values["abilities"] = tuple(names), Ability(values["abilities"] & _ABILITIES)
    return Description(name=name, **values)


def _parse_names(body: bytes, count: int) -> list[str]:
    names = []
    for _ in range(count):
        length = body[0]
        name, body = body[1 : 1 + length], body[1 + length :]
        if not 1 <= length <= MAX_NAME_BYTES or len(name) != length:
            raise MalformedMessage(
                f"a description came with a name of {length} bytes, {len(name)} sent"
            )
        try:
            names.append(name.decode())
        except UnicodeDecodeError as error:
            raise MalformedMessage(
                f"a description came with a name not in UTF-8: {name!r}"
            ) from error
    return names


def _parse_strobe(body: bytes) -> Strobe:
    (number,) = _NUMBER.unpack_from(body)
    slots = tuple(body[3 : 3 + body[2]])
    if len(slots) != body[2] or any(MAX_MARKERS <= slot < NO_MARKER for slot in slots):
        raise MalformedMessage("a schedule came cut short, or with a marker that cannot be")
    return Strobe(number, slots)
