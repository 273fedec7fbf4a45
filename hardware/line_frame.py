"""LineFrame: the scans of all sensors of one device in one exposure."""

from dataclasses import dataclass
from enum import IntFlag

import numpy as np
from numpy.typing import NDArray


class FrameFlag(IntFlag):
    """Status flags of a frame."""

    NONE = 0
    OVERFLOW = 1
    """Exposures were lost in the device before this one (the sequence number jumps)."""
    SATURATED = 2
    """At least one pixel is at full scale or at its full well."""


@dataclass(frozen=True, eq=False, slots=True)
class LineFrame:
    """The scans of all sensors of one device in one exposure.

    Args:
        device: the device's name.
        sequence: number of the exposure since the device was opened; gaps are lost exposures.
        exposure_device_ns: middle of the exposure on the device's clock [ns].
        exposure_host_ns: the same on the host's clock, as of time.time_ns() [ns].
        marker: number of the strobed marker that was lit, from 0; None when all were.
        lines: counts, uint16, shape (sensors, pixels); the driver does not write to it again;
            empty: exposed while nobody looked (``IdlingDriver``).
        flags: status of the frame.
        host_sigma_ns: standard deviation of ``exposure_host_ns``, one error of all frames, beyond
            the link's shortest delay [ns]; infinite while it is not known. 0: the device has the
            host's clock, or the frame comes from a recording.
    """

    device: str
    sequence: int
    exposure_device_ns: int
    exposure_host_ns: int
    marker: int | None
    lines: NDArray[np.uint16]
    flags: FrameFlag = FrameFlag.NONE
    host_sigma_ns: float = 0.0
