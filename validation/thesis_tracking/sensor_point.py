"""Position of a track along a sensor in one scan, and the interface of sensor trackers."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SensorPoint:
    """A running track along one sensor after a scan.

    Args:
        number: of the track, never used again on this sensor.
        position_px: of its point, made up where nothing was seen.
        peak: index of the point among those of the scan; -1: it is made up.
        life: scans in which its target was seen.
        deviation_px: of a point that is made up, as the method has it; 0 of one that was seen.
        shared: whether the point is another track's as well.
    """

    number: int
    position_px: float
    peak: int
    life: int
    deviation_px: float = 0.0
    shared: bool = False


class SensorTracker(Protocol):
    """Follows the targets of one sensor from scan to scan, and never looks ahead."""

    def step(
        self, position_px: Array, deviation_px: Array, interval_s: float, /
    ) -> Sequence[SensorPoint]:
        """Return where each running track is after the next scan.

        Args:
            position_px: points of the scan, shape (K,); NaN where there is none.
            deviation_px: their standard deviations, shape (K,).
            interval_s: the sampling period; scans are taken as equally far apart.
        """
        ...
