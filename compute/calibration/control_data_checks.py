"""Control points and readings, checked before a calibration: nothing wrong gets through."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from compute.camera import observation_checks
from compute.camera.model import PARAMETER_COUNT, SensorGeometry
from compute.camera.observation_checks import FLATNESS_LIMIT
from compute.errors import DegeneratePoints, TooFewPoints

Array = NDArray[np.float64]


def check_observations(
    points_mm: Array, readings_px: Array, sensors: Sequence[SensorGeometry], sigma_px: Array | None
) -> None:
    """Check control points (N, 3) and readings (N, S) with their deviations (N, S).

    Raises:
        InvalidParameter, NonFiniteValue, DuplicatePoint, ReadingOutsideSensor: see
            ``compute.camera.observation_checks``.
        TooFewPoints, DegeneratePoints: of a sensor, which it names.
    """
    observation_checks.check_observations(points_mm, readings_px, sensors, sigma_px)
    for column, sensor in enumerate(sensors):
        seen = points_mm[np.isfinite(readings_px[:, column])]
        _check_enough(seen, sensor)


def _check_enough(points_mm: Array, sensor: SensorGeometry) -> None:
    if len(points_mm) < PARAMETER_COUNT:
        raise TooFewPoints(
            f"sensor {sensor.name} saw {len(points_mm)} control points; "
            f"its {PARAMETER_COUNT} parameters need at least {PARAMETER_COUNT}",
            sensor=sensor.name,
            points=len(points_mm),
        )
    extent = np.linalg.svd(points_mm - points_mm.mean(axis=0), compute_uv=False)
    if extent[2] < FLATNESS_LIMIT * extent[0]:
        rms = extent / np.sqrt(len(points_mm))
        raise DegeneratePoints(
            f"the {len(points_mm)} control points that sensor {sensor.name} saw lie in one "
            f"plane (RMS extents {rms[0]:.3g} x {rms[1]:.3g} x {rms[2]:.3g} mm), which leaves "
            f"its parameters undetermined; the smallest extent must be at least "
            f"{FLATNESS_LIMIT:g} of the largest, and a third of it is a good choice",
            sensor=sensor.name,
        )
