"""Probabilistic tracker of section 6.2.2 on one sensor, exposure by exposure."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from validation.thesis_tracking.intervals import IntervalSettings
from validation.thesis_tracking.probabilistic_tracker import (
    AssociationSettings,
    ProbabilisticTracker,
)
from validation.thesis_tracking.sensor_point import SensorPoint
from validation.thesis_tracking.settings import ThesisSettings

Array = NDArray[np.float64]


class ProbabilisticSensorTracker:
    """Any number of targets along a sensor, by [6.6] to [6.10].

    A point that is made up has the deviation of its interval [6.7], of which the half width is two.

    Args:
        settings: of the method.
    """

    def __init__(self, settings: ThesisSettings) -> None:
        interval = IntervalSettings(
            settings.max_velocity_px_s,
            velocity=settings.interval_velocity,
            min_half_width_px=settings.min_interval_px,
        )
        model = AssociationSettings(
            interval,
            1.0,  # until the first scans tell
            settings.swap_threshold,
            young_scans=settings.young_scans,
            coast_scans=settings.coast_scans,
        )
        self._tracker = ProbabilisticTracker(model)

    def step(
        self, position_px: Array, _deviation_px: Array, interval_s: float
    ) -> Sequence[SensorPoint]:
        """Return where each running track is after the next scan; see SensorTracker."""
        found = self._tracker.step(position_px, interval_s)
        self._tracker.forget()
        return found
