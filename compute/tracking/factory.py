"""create_tracker: what follows markers, by the method that the settings name."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from compute.tracking.settings import TrackerSettings
from compute.tracking.thesis.settings import ThesisSettings

if TYPE_CHECKING:
    from compute.camera.stack import CameraStack
    from compute.mapping.table import CorrectionTable
    from compute.tracking.thesis.thesis_tracker import ThesisTracker
    from compute.tracking.tracker import Tracker

Array = NDArray[np.float64]

TrackingSettings = TrackerSettings | ThesisSettings
"""Filtering on readings, or one of the thesis's methods."""


def create_tracker(
    cameras: "CameraStack",
    settings: TrackingSettings,
    parameter_covariance: Array | None = None,
    corrections: "CorrectionTable | None" = None,
    pixels: tuple[int, ...] | None = None,
) -> "Tracker | ThesisTracker":
    """Return the tracker of the settings; arguments and errors as of ``Tracker``."""
    if isinstance(settings, ThesisSettings):
        from compute.tracking.thesis.thesis_tracker import ThesisTracker

        return ThesisTracker(cameras, settings, parameter_covariance, corrections, pixels)
    from compute.tracking.tracker import Tracker

    return Tracker(cameras, settings, parameter_covariance, corrections, pixels)
