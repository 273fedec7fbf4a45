"""Stationary markers as arrays for the computation."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.calibration.drift.stability_check import StationaryMarkers
from compute.calibration.result import Calibration
from compute.errors import InvalidParameter
from hardware.driver import SensorDescription
from service.api.calibrations.calibration_content import observations
from service.api.calibrations.schema import Reading
from service.api.drift_checks.schema import StationaryMarker

Array = NDArray[np.float64]

MAX_READINGS = 1000
"""Most readings of one set: their joint covariance is solved within a request."""


@dataclass(frozen=True)
class _Earlier:
    name: str
    readings: dict[str, float | Reading]


def marker_arrays(
    markers: Sequence[StationaryMarker],
    sensors: Sequence[SensorDescription],
    calibration: Calibration,
    position_sigma_mm: float,
) -> StationaryMarkers:
    """Return markers as arrays, with their earlier readings or their positions as reference.

    Readings without a standard deviation take the calibration's.

    Args:
        markers: all of them with earlier readings, or all of them with positions.
        sensors: the device's.
        calibration: the calibration in question.
        position_sigma_mm: standard deviation of each coordinate of the positions [mm].

    Raises:
        DuplicatePoint, UnknownSensor, ReadingOutsideSensor: as ``observations``.
        InvalidParameter: more readings than are taken.
    """
    size = len(markers) * len(sensors)
    if size > MAX_READINGS:
        raise InvalidParameter(
            f"{len(markers)} markers of {len(sensors)} sensors are {size} readings; at most "
            f"{MAX_READINGS} are taken: give fewer markers, spread over the volume",
            readings=size,
        )
    now, sigma = _arrays(markers, sensors, calibration)
    if markers[0].earlier is None:
        places = np.array([marker.position_mm for marker in markers], dtype=np.float64)
        return StationaryMarkers(now, sigma, places.reshape(-1, 3), position_sigma_mm)
    before, before_sigma = _arrays(
        [_Earlier(marker.name, marker.earlier or {}) for marker in markers], sensors, calibration
    )
    return StationaryMarkers(now, sigma, earlier_px=before, earlier_sigma_px=before_sigma)


def _arrays(
    markers: Sequence[StationaryMarker] | Sequence[_Earlier],
    sensors: Sequence[SensorDescription],
    calibration: Calibration,
) -> tuple[Array, Array]:
    """Return readings and their sigma, shape (N, S) [px]."""
    found = observations(markers, sensors)
    own = np.array([fit.sigma_px for fit in calibration.sensors])
    return found.readings_px, np.where(np.isfinite(found.sigma_px), found.sigma_px, own)
