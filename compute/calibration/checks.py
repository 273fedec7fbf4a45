"""Control points and readings, checked before a calibration: nothing wrong gets through."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import PARAMETER_COUNT, SensorGeometry
from compute.errors import (
    DegeneratePoints,
    DuplicatePoint,
    InvalidParameter,
    NonFiniteValue,
    ReadingOutsideSensor,
    TooFewPoints,
)

Array = NDArray[np.float64]

FLATNESS_LIMIT = 1e-3
"""Smallest extent of the control points, as a fraction of their largest, that is not flat."""
SAME_POSITION_MM = 1e-6
SIGMA_RANGE_PX = (1e-6, 1e4)
"""Standard deviations that mean something, and whose squares keep their digits."""


def check_observations(
    points_mm: Array, readings_px: Array, sensors: Sequence[SensorGeometry], sigma_px: Array | None
) -> None:
    """Check control points (N, 3) and readings (N, S) with their deviations (N, S).

    Raises:
        InvalidParameter: shapes that do not fit, or a standard deviation that is not positive.
        NonFiniteValue, DuplicatePoint, ReadingOutsideSensor, TooFewPoints, DegeneratePoints:
            as they say; each names the point, counted from 1, or the sensor.
    """
    if points_mm.ndim != 2 or points_mm.shape[1] != 3:
        raise InvalidParameter(f"points have shape {points_mm.shape}; it must be (N, 3)")
    if readings_px.shape != (len(points_mm), len(sensors)):
        raise InvalidParameter(
            f"readings have shape {readings_px.shape}; {len(points_mm)} points and "
            f"{len(sensors)} sensors make ({len(points_mm)}, {len(sensors)})"
        )
    bad = np.argwhere(~np.isfinite(points_mm))
    if len(bad):
        row, axis = bad[0]
        raise NonFiniteValue(
            f"point {row + 1} has {'XYZ'[axis]} = {points_mm[row, axis]}; it must be finite",
            point=int(row) + 1,
        )
    if np.isinf(readings_px).any():
        row, column = np.argwhere(np.isinf(readings_px))[0]
        raise NonFiniteValue(
            f"the reading of point {row + 1} by sensor {sensors[column].name} is "
            f"{readings_px[row, column]}; it must be finite (leave out what was not seen)",
            point=int(row) + 1,
            sensor=sensors[column].name,
        )
    _check_distinct(points_mm)
    check_inside(readings_px, sensors)
    if sigma_px is not None:
        _check_sigma(sigma_px, readings_px, sensors)
    for column, sensor in enumerate(sensors):
        seen = points_mm[np.isfinite(readings_px[:, column])]
        _check_enough(seen, sensor)


def check_inside(readings_px: Array, sensors: Sequence[SensorGeometry]) -> None:
    """Check that readings (N, S) [px] lie on the sensors' pixels; NaN counts as not seen.

    Raises:
        ReadingOutsideSensor: the first reading outside, with its point, counted from 1.
    """
    pixels = np.array([sensor.pixels for sensor in sensors])
    with np.errstate(invalid="ignore"):
        outside = np.argwhere((readings_px < -0.5) | (readings_px > pixels - 0.5))
    if len(outside):
        row, column = outside[0]
        sensor = sensors[column]
        raise ReadingOutsideSensor(
            f"the reading {readings_px[row, column]:g} px of point {row + 1} lies outside "
            f"sensor {sensor.name}, whose {sensor.pixels} pixels reach from -0.5 to "
            f"{sensor.pixels - 0.5:g} px",
            point=int(row) + 1,
            sensor=sensor.name,
            reading_px=float(readings_px[row, column]),
        )


def _check_distinct(points_mm: Array) -> None:
    order = np.lexsort(points_mm.T)
    gaps = np.abs(np.diff(points_mm[order], axis=0)).max(axis=1)
    same = np.flatnonzero(gaps <= SAME_POSITION_MM)
    if len(same):
        first, second = sorted((int(order[same[0]]), int(order[same[0] + 1])))
        raise DuplicatePoint(
            f"points {first + 1} and {second + 1} have the same position "
            f"{tuple(points_mm[first].tolist())} mm; give each control point once "
            "(average repeated readings)",
            points=(first + 1, second + 1),
        )


def _check_sigma(sigma_px: Array, readings_px: Array, sensors: Sequence[SensorGeometry]) -> None:
    if sigma_px.shape != readings_px.shape:
        raise InvalidParameter(
            f"standard deviations have shape {sigma_px.shape}, readings {readings_px.shape}"
        )
    low, high = SIGMA_RANGE_PX
    wrong = np.isfinite(readings_px) & ~((sigma_px >= low) & (sigma_px <= high))
    if wrong.any():
        row, column = np.argwhere(wrong)[0]
        raise InvalidParameter(
            f"the standard deviation of point {row + 1} by sensor {sensors[column].name} is "
            f"{sigma_px[row, column]} px; it must lie in {low:g} .. {high:g} px"
        )


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
