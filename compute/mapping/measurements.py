"""MappingMeasurements: markers at known places and what the sensors read of them, checked."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.errors import (
    DegeneratePoints,
    DuplicatePoint,
    InvalidParameter,
    NonFiniteValue,
    ReadingOutsideSensor,
    TooFewPoints,
)

Array = NDArray[np.float64]

LEAST_POINTS = 8
"""Of each sensor: the corners of one cell."""
FLATNESS_LIMIT = 1e-3
"""Smallest extent of the points, as a fraction of their largest, that is not flat."""
ONE_SIDED_LIMIT = 0.1
"""Least share of the extent of all points, along their axes, that a sensor's points must have."""
SAME_POSITION_MM = 1e-6
SIGMA_RANGE_PX = (1e-6, 1e4)
"""Standard deviations that mean something, and whose squares keep their digits."""


@dataclass(frozen=True, eq=False)
class MappingMeasurements:
    """Readings of markers at known places.

    Args:
        points_mm: where the markers were, shape (N, 3) [mm].
        readings_px: what was read of them, shape (N, S) [px]; NaN where not seen.
        sigma_px: standard deviations of the readings, shape (N, S) [px]; None: not known, then
            they are estimated from what the fit leaves, one for each sensor.
        point_sigma_mm: standard deviation of each coordinate of the places, the same for all and
            independent of one another [mm].
    """

    points_mm: Array
    readings_px: Array
    sigma_px: Array | None = None
    point_sigma_mm: float = 0.0

    def variance_px2(self, cameras: CameraStack) -> Array:
        """Return the variances of the readings, the places' own projected in, shape (N, S).

        Without standard deviations the places' share alone is known.
        """
        slope = cameras.linearised(self.points_mm)[1]
        variance: Array = self.point_sigma_mm**2 * (slope**2).sum(axis=2)
        if self.sigma_px is not None:
            variance = variance + self.sigma_px**2
        return np.where(np.isfinite(self.readings_px), variance, np.nan)


def check_measurements(measured: MappingMeasurements, models: Sequence[SensorModel]) -> None:
    """Check measurements against the sensors they are of.

    Raises:
        InvalidParameter: shapes that do not fit, or a standard deviation that means nothing.
        NonFiniteValue, DuplicatePoint, ReadingOutsideSensor, TooFewPoints, DegeneratePoints:
            as they say; each names the point, counted from 1, or the sensor.
    """
    points, readings = measured.points_mm, measured.readings_px
    if points.ndim != 2 or points.shape[1] != 3:
        raise InvalidParameter(f"points_mm has the shape {points.shape}; it must be (N, 3)")
    right = (len(points), len(models))
    if readings.shape != right:
        raise InvalidParameter(
            f"readings_px has the shape {readings.shape}; {len(points)} points and the "
            f"calibration's {len(models)} sensors make {right}"
        )
    bad = np.argwhere(~np.isfinite(points))
    if len(bad):
        row, axis = bad[0]
        raise NonFiniteValue(
            f"point {row + 1} has {'XYZ'[axis]} = {points[row, axis]}; it must be finite",
            point=int(row) + 1,
        )
    if np.isinf(readings).any():
        row, column = np.argwhere(np.isinf(readings))[0]
        raise NonFiniteValue(
            f"the reading of point {row + 1} by sensor {models[column].name} is "
            f"{readings[row, column]}; it must be finite, or NaN for what was not seen",
            point=int(row) + 1,
            sensor=models[column].name,
        )
    _check_sigma(measured, models)
    pairs = cKDTree(points).query_pairs(SAME_POSITION_MM, output_type="ndarray")
    if len(pairs):
        first, second = min(map(tuple, pairs.tolist()))
        raise DuplicatePoint(
            f"points {first + 1} and {second + 1} have the same position "
            f"{points[first].tolist()} mm; give a place once, with the mean of its readings",
            point=second + 1,
        )
    whole = _extents(points) if len(points) >= LEAST_POINTS else None
    for column, model in enumerate(models):
        _check_sensor(points, readings[:, column], model, whole)


def _check_sigma(measured: MappingMeasurements, models: Sequence[SensorModel]) -> None:
    spread = measured.point_sigma_mm
    if not 0.0 <= spread < np.inf:
        raise InvalidParameter(f"point_sigma_mm is {spread}; it must be 0 or positive")
    sigma, readings = measured.sigma_px, measured.readings_px
    if sigma is None:
        return
    if sigma.shape != readings.shape:
        raise InvalidParameter(
            f"sigma_px has the shape {sigma.shape}; the readings have {readings.shape}"
        )
    low, high = SIGMA_RANGE_PX
    with np.errstate(invalid="ignore"):
        wrong = np.argwhere(np.isfinite(readings) & ~((sigma >= low) & (sigma <= high)))
    if len(wrong):
        row, column = wrong[0]
        raise InvalidParameter(
            f"the standard deviation of the reading of point {row + 1} by sensor "
            f"{models[column].name} is {sigma[row, column]} px; it must be from {low:g} to "
            f"{high:g}",
            point=int(row) + 1,
            sensor=models[column].name,
        )


def _check_sensor(points: Array, readings: Array, model: SensorModel, whole: Array | None) -> None:
    seen = np.isfinite(readings)
    outside = np.flatnonzero(seen & ~((readings >= -0.5) & (readings <= model.pixels - 0.5)))
    if len(outside):
        row = int(outside[0])
        raise ReadingOutsideSensor(
            f"the reading of point {row + 1} by sensor {model.name} is {readings[row]} px; its "
            f"pixels reach from -0.5 to {model.pixels - 0.5}",
            point=row + 1,
            sensor=model.name,
        )
    count = int(seen.sum())
    if count < LEAST_POINTS or whole is None:
        raise TooFewPoints(
            f"sensor {model.name} saw {count} of the mapping points; at least {LEAST_POINTS} are "
            "needed, and as many more as the volume is to be resolved",
            sensor=model.name,
            points=count,
        )
    extents = _extents(points[seen])
    if extents[2] < FLATNESS_LIMIT * extents[0]:
        raise DegeneratePoints(
            f"the {count} points that sensor {model.name} saw lie in one plane or line: "
            f"{extents[0]:.4g} x {extents[1]:.4g} x {extents[2]:.4g} mm along their axes; a table "
            "over a volume needs points at several depths",
            sensor=model.name,
        )
    share = float((extents / whole).min())
    if share < ONE_SIDED_LIMIT:
        raise DegeneratePoints(
            f"sensor {model.name} saw points on one side only: they reach over {100 * share:.1f} "
            f"% of the mapped volume in one direction, at least {100 * ONE_SIDED_LIMIT:g} % are "
            "needed; add points where it has none, or map the others' volume without it",
            sensor=model.name,
        )


def _extents(points: Array) -> Array:
    """Return the points' extents along their principal axes, largest first, shape (3,) [mm]."""
    centred = points - points.mean(axis=0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    extents: Array = np.sort(np.ptp(centred @ axes.T, axis=0))[::-1]
    return extents
