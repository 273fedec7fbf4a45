"""The board's protocol: encoding of requests, register bounds, timing."""

import struct
from dataclasses import dataclass
from typing import Final

from compute.errors import InvalidParameter
from compute.parameter_checks import require

KEY: Final = b"ER"
ELEMENTS: Final = 3694
"""Elements of a readout: 32 dummy elements, the pixels, 14 dummy elements."""

PIXELS: Final = 3648
FIRST_PIXEL: Final = 32
SHIELDED: Final = slice(16, 29)
"""The dummy elements D16 to D28, pixels under a light shield: they show the dark level."""

RESPONSE_BYTES: Final = 2 * ELEMENTS
PITCH_UM: Final = 8.0
BITS: Final = 12
FULL_SCALE: Final = 2**BITS - 1

CLOCK_HZ: Final = 2_000_000
"""The master clock of the firmware as it is given out; SH and ICG count its periods."""

READOUT_CLOCKS: Final = 4 * ELEMENTS
MIN_ICG_CLOCKS: Final = READOUT_CLOCKS
MIN_EXPOSURE_US: Final = 10
_MAX_CLOCKS: Final = 2**32 - 1
_FLUSH_CLOCKS: Final = 4 * 15_000  # the firmware empties the CCD at this pace before it reads
_PULSES_BEFORE: Final = 4  # ICG pulses from the new periods to the reading, at most
REQUEST_LAYOUT: Final = struct.Struct(">2sIIBB")
"""Key, SH period, ICG period, continuous, averages."""


@dataclass(frozen=True)
class Request:
    """A request to the board: one scan, or scans until the next request.

    Args:
        sh_clocks: SH period in periods of the master clock: the exposure.
        icg_clocks: ICG period, likewise: from one reading to the next; n times ``sh_clocks``.
        averages: lines that the board averages, 1 to 255.
        continuous: True: lines without end, and without a gap between them; False: one.
        clock_hz: the master clock of the board's firmware.

    Raises:
        InvalidParameter: the board would not do it.
    """

    sh_clocks: int
    icg_clocks: int
    averages: int = 1
    continuous: bool = False
    clock_hz: int = CLOCK_HZ

    def __post_init__(self) -> None:
        min_sh = -(-self.clock_hz * MIN_EXPOSURE_US // 1_000_000)
        if not min_sh <= self.sh_clocks <= _MAX_CLOCKS:
            raise InvalidParameter(
                f"SH period is {self.sh_clocks}; it must lie between {min_sh} and {_MAX_CLOCKS} "
                f"periods of {self.clock_hz} Hz: the CCD needs {MIN_EXPOSURE_US} us",
                sh_clocks=self.sh_clocks,
            )
        if not MIN_ICG_CLOCKS <= self.icg_clocks <= _MAX_CLOCKS:
            raise InvalidParameter(
                f"ICG period is {self.icg_clocks}; it must lie between {MIN_ICG_CLOCKS}, what "
                f"reading {ELEMENTS} elements takes, and {_MAX_CLOCKS}",
                icg_clocks=self.icg_clocks,
            )
        if self.icg_clocks % self.sh_clocks:
            above = -(-self.icg_clocks // self.sh_clocks) * self.sh_clocks
            raise InvalidParameter(
                f"ICG period is {self.icg_clocks}, no multiple of the SH period "
                f"{self.sh_clocks}; {above} is one",
                icg_clocks=self.icg_clocks,
                sh_clocks=self.sh_clocks,
            )
        require(1 <= self.averages <= 255, "lie between 1 and 255", averages=self.averages)

    def encode(self) -> bytes:
        """Return the 12 bytes, which must be sent in one write."""
        return REQUEST_LAYOUT.pack(
            KEY, self.sh_clocks, self.icg_clocks, self.continuous, self.averages
        )

    @property
    def exposure_ns(self) -> int:
        """Length of one exposure [ns]."""
        return self._ns(self.sh_clocks)

    @property
    def end_to_response_ns(self) -> int:
        """Readout time, from the end of the last exposure to the first bit of the response [ns]."""
        return self._ns(READOUT_CLOCKS)

    @property
    def centre_to_response_ns(self) -> int:
        """Time from the centre of all exposures to the first bit of the response [ns]."""
        averaging_ns = (self.averages - 1) * self._ns(self.icg_clocks)
        return self.end_to_response_ns + (self.exposure_ns + averaging_ns) // 2

    @property
    def max_wait_ns(self) -> int:
        """Longest time until a working board begins to respond [ns].

        The firmware empties the CCD, sets the new periods and lets some pass before it reads.
        """
        pulses = _PULSES_BEFORE + self.averages
        return self._ns(_FLUSH_CLOCKS + pulses * self.icg_clocks + READOUT_CLOCKS)

    def _ns(self, clocks: int) -> int:
        return clocks * 1_000_000_000 // self.clock_hz


def request_for(exposure_us: float, averages: int = 1, clock_hz: int = CLOCK_HZ) -> Request:
    """Return the request with the nearest possible exposure and the earliest readout.

    Args:
        exposure_us: length of one exposure [us].
        averages: lines that the board averages.
        clock_hz: the master clock of the board's firmware.

    Raises:
        InvalidParameter: the exposure is too short or too long.
    """
    sh_clocks = round(exposure_us * clock_hz / 1e6)
    pulses = max(1, -(-MIN_ICG_CLOCKS // max(1, sh_clocks)))
    return Request(sh_clocks, pulses * sh_clocks, averages, clock_hz=clock_hz)
