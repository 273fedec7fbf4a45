"""BarPlacement: where a simulated bar stands in a hall that several bars look into."""

import time
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from hardware.clock_sync import host_clock_offset_ns
from hardware.field_bounds import CheckedSettings
from hardware.simulated.scenes import Point, RotationVector, rotation_of

Array = NDArray[np.float64]

DAY_NS: Final = 86_400_000_000_000
"""Time in a hall begins anew each day, so that a float holds it."""


@dataclass(frozen=True)
class BarPlacement(CheckedSettings):
    """Place and rotation of a bar in a hall, whose time is the host's.

    All bars of a hall see the same scene at the same time, whenever each was started; those of one
    rate light the same marker. The noise is that of the seed, the scene is not.

    Args:
        position_mm: the bar's origin in the hall, where it is from its middle [mm].
        rotation_rad: rotation of the bar's axes in the hall, a rotation vector [rad].
        delay_ms: how much later than those of a bar without a delay its exposures are [ms].

    Raises:
        InvalidParameter: a value is outside of its bounds.
    """

    position_mm: Point = (0.0, 0.0, 0.0)
    rotation_rad: RotationVector = (0.0, 0.0, 0.0)
    delay_ms: Annotated[float, Field(ge=0.0, le=1e5)] = 0.0

    def in_bar(self, points_mm: Array) -> Array:
        """Return points of the hall (..., 3) in the bar's own coordinates."""
        rotation = rotation_of(np.asarray(self.rotation_rad, dtype=np.float64))
        moved: Array = (points_mm - np.asarray(self.position_mm)) @ rotation
        return moved

    def begin(self, cycle_s: float) -> tuple[int, int]:
        """Return when the first exposure may begin: the next cycle, and the delay [ns].

        Args:
            cycle_s: from one exposure of a marker to the next [s].

        Returns:
            On the host's clock, and on the monotonic one.
        """
        cycle_ns = max(1, round(1e9 * cycle_s))
        monotonic_ns = time.monotonic_ns()
        now_ns = monotonic_ns + host_clock_offset_ns()
        today_ns = now_ns % DAY_NS
        ahead_ns = -today_ns % cycle_ns + round(1e6 * self.delay_ms)
        return now_ns + ahead_ns, monotonic_ns + ahead_ns
