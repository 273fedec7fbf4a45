"""Parses the content of one message whose checksum is verified."""

import math
import struct
from collections.abc import Callable
from typing import Final

import numpy as np

from hardware.serial import encoding
from hardware.serial.messages import (
    MAX_MARKERS,
    MAX_NAME_BYTES,
    MAX_PIXELS,
    MAX_SENSORS,
    MAX_VALUE,
    NO_MARKER,
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

_HEAD: Final = encoding.HEAD.size
_COUNTS: Final = _HEAD + encoding.LINES.size
_FLAGS: Final = tuple(LinesFlag(value & LinesFlag.SATURATED) for value in range(256))
_TINY: Final = math.ulp(0.0)
_COUNT: Final = np.dtype("<u2")


class MalformedMessage(Exception):
    """Invalid content despite a correct checksum."""


def parse(content: bytes) -> Message | None:
    """Return the message of a content without its checksum; None: unknown type.

    Raises:
        Malformed: it is not as long as it should be, or a value is out of its bounds.
    """
    kind = content[1]
    if kind == MessageType.LINES:
        return _lines(content)
    parser = _PARSERS.get(kind)
    if parser is None:
        return None
    try:
        return parser(content[_HEAD:])
    except (struct.error, IndexError) as error:
        name = MessageType(kind).name.lower()
        raise MalformedMessage(f"a message {name} came that ends too early ({error})") from error


def _lines(content: bytes) -> Lines:
    if len(content) < _COUNTS + 2 or len(content) % 2:
        raise MalformedMessage(f"lines came in a message of {len(content)} bytes")
    marker, flags, sequence, ticks, lost, first = encoding.LINES.unpack_from(content, _HEAD)
    counts = np.frombuffer(content, _COUNT, offset=_COUNTS)
    return Lines(sequence, ticks, marker, _FLAGS[flags], lost, first, counts)


def _description(body: bytes) -> Description:
    (
        abilities, bits, sensors, markers, pixels, clock_bits, _, clock_hz,
        pitch, gain, noise, offset, rate, exposure, delay, sigma,
    ) = encoding.DESCRIPTION.unpack_from(body)  # fmt: skip
    names, place = [], encoding.DESCRIPTION.size
    for _ in range(1 + sensors):
        length = body[place]
        name = body[place + 1 : place + 1 + length]
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
        place += 1 + length
    bounds = (
        ("number of sensors", sensors, 1, MAX_SENSORS),
        ("number of pixels", pixels, 1, MAX_PIXELS),
        ("number of markers", markers, 0, MAX_MARKERS),
        ("number of bits of the conversion", bits, 1, 16),
        ("number of bits of the clock", clock_bits, 16, 64),
        ("clock rate", clock_hz, 1, math.inf),
        ("pixel pitch", pitch, _TINY, MAX_VALUE),
        ("gain", gain, _TINY, MAX_VALUE),
        ("read noise", noise, 0.0, MAX_VALUE),
        ("offset", offset, -MAX_VALUE, MAX_VALUE),
        ("frame rate", rate, 0.0, 1e6),
        ("exposure time", exposure, 0.0, MAX_VALUE),
        ("delay", delay, 0.0, MAX_VALUE),
        ("line width", sigma, 0.0, MAX_VALUE),
    )
    for what, value, least, most in bounds:
        if not least <= value <= most:
            asked = "above 0" if least == _TINY else f"{least:g} to {most:g}"
            raise MalformedMessage(f"a description came with {what} {value:g}; it must be {asked}")
    if len(set(names[1:])) < sensors:
        raise MalformedMessage(
            f"a description came with sensors of one name: {', '.join(names[1:])}"
        )
    return Description(
        names[0], tuple(names[1:]), pixels, pitch, clock_hz, clock_bits, bits, gain, noise,
        offset, rate, exposure, delay, sigma, markers, Ability(abilities & _ABILITIES),
    )  # fmt: skip


_ABILITIES: Final = int(Ability.START_STOP | Ability.EXPOSURE | Ability.STROBE)


def _status(body: bytes) -> DeviceStatus:
    _, ticks, temperature, lost, garbled = encoding.STATUS.unpack_from(body)
    return DeviceStatus(ticks, temperature, lost, garbled)


def _answer(body: bytes) -> Answer:
    command, result, number = encoding.ANSWER.unpack_from(body)
    return Answer(command, number, result)


def _exposure(body: bytes) -> Exposure:
    number, rate, exposure = encoding.EXPOSURE.unpack_from(body)
    if not (0.0 <= rate < math.inf and 0.0 <= exposure < math.inf):
        raise MalformedMessage(f"a command came with {rate} Hz and an exposure of {exposure} us")
    return Exposure(number, rate, exposure)


def _strobe(body: bytes) -> Strobe:
    (number,) = encoding.NUMBER.unpack_from(body)
    slots = tuple(body[3 : 3 + body[2]])
    if len(slots) != body[2] or any(MAX_MARKERS <= slot < NO_MARKER for slot in slots):
        raise MalformedMessage("a schedule came cut short, or with a marker that cannot be")
    return Strobe(number, slots)


def _number(body: bytes) -> int:
    number: int = encoding.NUMBER.unpack_from(body)[0]
    return number


_PARSERS: Final[dict[int, Callable[[bytes], Message]]] = {
    MessageType.DESCRIPTION: _description,
    MessageType.STATUS: _status,
    MessageType.ANSWER: _answer,
    MessageType.DESCRIBE: lambda body: Describe(_number(body)),
    MessageType.START: lambda body: Start(_number(body)),
    MessageType.STOP: lambda body: Stop(_number(body)),
    MessageType.EXPOSURE: _exposure,
    MessageType.STROBE: _strobe,
}
