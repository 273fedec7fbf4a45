"""LineFrame: all lines that one device read in one exposure; the only thing that leaves here."""

from dataclasses import dataclass
from enum import IntFlag

import numpy as np
from numpy.typing import NDArray


class FrameFlag(IntFlag):
    """What a device says of a frame."""

    NONE = 0
    OVERFLOW = 1
    """Exposures were lost in the device before this one (the sequence number jumps)."""
    SATURATED = 2
    """At least one pixel is at full scale, or holds all that it can."""


@dataclass(frozen=True, eq=False, slots=True)
class LineFrame:
    """All lines of one exposure.

    Args:
        device: the device's name.
        sequence: number of the exposure since the device was opened; gaps are lost exposures.
        exposure_device_ns: middle of the exposure on the device's clock [ns].
        exposure_host_ns: the same on the host's clock, as time.time_ns() counts [ns].
        marker: number of the strobed marker that was lit, from 0; None when all were.
        lines: counts, uint16, shape (sensors, pixels); not written to again by the driver.
        flags: what the device says of the frame.
    """

    device: str
    sequence: int
    exposure_device_ns: int
    exposure_host_ns: int
    marker: int | None
    lines: NDArray[np.uint16]
    flags: FrameFlag = FrameFlag.NONE
