"""A calibration with all that is said of it: labels, cross-validation, diagnosis."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.assessment.cross_validation import cross_validate
from compute.calibration.assessment.diagnosis import diagnose
from compute.calibration.calibrate import calibrate
from compute.calibration.effective_readings import effective_readings
from compute.calibration.result import Calibration
from compute.calibration.settings import DEFAULTS, CalibrationSettings
from compute.camera.model import SensorGeometry

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]

MAX_LEAVE_ONE_OUT_POINTS: Final = 100
"""Most control points that are left out one by one; more are left out in blocks only."""


def calibrate_and_assess(
    points_mm: Array,
    readings_px: Array,
    sensors: Sequence[SensorGeometry],
    sigma_px: Array | None = None,
    settings: CalibrationSettings = DEFAULTS,
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate, predict points and blocks that were left out, and diagnose.

    Arguments and errors are those of ``calibrate``; the result also has ``cross_validation`` (by
    blocks of space, before it by points where these are few) and ``diagnosis``.
    """

    def part(first: float, last: float) -> Progress | None:
        if progress is None:
            return None
        return lambda done, stage: progress(first + (last - first) * done, stage)

    found = calibrate(points_mm, readings_px, sensors, sigma_px, settings, progress=part(0.0, 0.5))
    given = points_mm, readings_px, sensors, sigma_px
    checks = []
    if len(points_mm) <= MAX_LEAVE_ONE_OUT_POINTS:
        checks.append(cross_validate(found, *given, "points", part(0.5, 0.75)))
    checks.append(cross_validate(found, *given, "blocks", part(0.75, 0.9)))
    used, _ = effective_readings(found, readings_px)
    diagnosis = diagnose(found, points_mm, used, part(0.9, 1.0))
    return replace(found, cross_validation=tuple(checks), diagnosis=diagnosis)
