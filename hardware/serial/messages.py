"""The messages of the line-scan protocol: their types, numbers and limits.

Byte by byte in docs/reference/serial-protocol.md; ``encoding`` writes them, ``parsing`` reads them.
"""

from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Final

import numpy as np
from numpy.typing import NDArray

VERSION: Final = 1
NO_MARKER: Final = 255
MAX_SENSORS: Final = 64
MAX_PIXELS: Final = 65_535
MAX_NAME_BYTES: Final = 64
MAX_VALUE: Final = 1e9
"""Bound of a description's values that have no other."""
MAX_BYTES: Final = 2**20
"""Maximum length of an encoded message [bytes]."""


class MessageType(IntEnum):
    """Message type, the second byte of every message; 0x80 and above come from the host."""

    DESCRIPTION = 0x01
    LINES = 0x02
    STATUS = 0x03
    ANSWER = 0x04
    DESCRIBE = 0x81
    START = 0x82
    STOP = 0x83
    EXPOSURE = 0x84
    STROBE = 0x85


class Ability(IntFlag):
    """Optional commands that a device supports."""

    NONE = 0
    START_STOP = 1
    EXPOSURE = 2
    STROBE = 4


class LinesFlag(IntFlag):
    """Status flags of an exposure."""

    NONE = 0
    SATURATED = 1


class Result(IntEnum):
    """Result of a command."""

    DONE = 0
    UNKNOWN = 1
    """It does not know the command."""
    OUT_OF_RANGE = 2
    """It cannot do what the command asks for; it goes on as before."""
    BUSY = 3


@dataclass(frozen=True)
class Description:
    """Description of a device; sent after power-on and on request.

    Args:
        name: what the device calls itself, with a serial number where it has one.
        sensors: the names of its S sensors.
        pixels: of each sensor.
        pitch_um: pixel pitch [um].
        clock_hz: ticks of its clock per second.
        clock_bits: its clock begins anew after 2**clock_bits ticks; 16 to 64.
        bits: resolution of the conversion.
        electrons_per_count: gain of the conversion.
        read_noise_electrons: standard deviation of the read noise.
        offset_counts: the count without light.
        frame_rate_hz: exposures per second, as it is set now.
        exposure_us: their duration [us], as it is set now; 0: not known.
        delay_us: from the middle of an exposure to its first byte on the line [us]; 0: not known.
        line_sigma_px: standard deviation of light lines, where it is known; 0: it is not.
        markers: number of strobed markers; 0: all are lit together.
        abilities: which commands it obeys.
    """

    name: str
    sensors: tuple[str, ...]
    pixels: int
    pitch_um: float
    clock_hz: int
    clock_bits: int = 32
    bits: int = 12
    electrons_per_count: float = 1.0
    read_noise_electrons: float = 0.0
    offset_counts: float = 0.0
    frame_rate_hz: float = 0.0
    exposure_us: float = 0.0
    delay_us: float = 0.0
    line_sigma_px: float = 0.0
    markers: int = 0
    abilities: Ability = Ability.NONE


@dataclass(frozen=True, eq=False, slots=True)
class Lines:
    """Consecutive counts of one exposure, all of them or a part.

    Args:
        sequence: number of the exposure since the device began, modulo 2**32.
        ticks: middle of the exposure on the device's clock.
        marker: the strobed marker that was lit; NO_MARKER: all were.
        flags: what the device says of the exposure.
        lost: exposures that the device could not send since it began, modulo 2**32.
        first: index of the first count in the exposure's S x P counts, sensor by sensor.
        counts: uint16, shape (n,).
    """

    sequence: int
    ticks: int
    marker: int
    flags: LinesFlag
    lost: int
    first: int
    counts: NDArray[np.uint16]


@dataclass(frozen=True)
class DeviceStatus:
    """Status of a device; sent about once a second, also while stopped. Optional.

    Args:
        ticks: its clock now.
        temperature_c: NaN: not known.
        lost: as in ``Lines``.
        garbled: messages of the host that it threw away.
    """

    ticks: int
    temperature_c: float = float("nan")
    lost: int = 0
    garbled: int = 0


@dataclass(frozen=True)
class Answer:
    """Answer to a command: the command's type and number, and the result."""

    command: int
    number: int
    result: int


@dataclass(frozen=True)
class Describe:
    """Command: send the description."""

    number: int


@dataclass(frozen=True)
class Start:
    """Command: start exposures."""

    number: int


@dataclass(frozen=True)
class Stop:
    """Command: stop exposures."""

    number: int


@dataclass(frozen=True)
class Exposure:
    """Command: set frame rate [Hz] and exposure time [us]; 0: unchanged."""

    number: int
    frame_rate_hz: float
    exposure_us: float


@dataclass(frozen=True)
class Strobe:
    """Command: set the cyclic strobe schedule.

    Args:
        number: of the command.
        slots: markers, NO_MARKER for an exposure in which all are lit; empty: all, always.
    """

    number: int
    slots: tuple[int, ...]


FromDevice = Description | Lines | DeviceStatus | Answer
FromHost = Describe | Start | Stop | Exposure | Strobe
Message = FromDevice | FromHost
