"""Checks of known points and their readings: shapes, values, duplicates, coverage."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from compute.camera.model import PARAMETER_COUNT, SensorGeometry, SensorModel
from compute.errors import (
    DegeneratePoints,
    DuplicatePoint,
    ImplausibleReadings,
    InvalidParameter,
    NonFiniteValue,
    ReadingOutsideSensor,
    TooFewPoints,
)

Array = NDArray[np.float64]

FLATNESS_LIMIT: Final = 1e-3
"""Smallest extent of points, as a fraction of their largest, that is not flat."""
MIN_POINT_DISTANCE_MM: Final = 1e-6
SIGMA_RANGE_PX: Final = (1e-6, 1e4)
"""Range of standard deviations that are plausible and whose squares keep their digits."""


MAX_RESIDUAL_SHARE: Final = 0.7
"""Largest standard deviation of residuals, relative to that of the readings, with which a camera
explains the readings. Of readings that are drawn at random it leaves about 1; of any sensor that
saw the points, a few per cent."""
COPY_DECIMALS: Final = range(7)
"""Decimals to which one column of readings may be a rounded copy of another."""
UNEXPLAINED_PROBABILITY: Final = 0.01
"""Probability with which correct standard deviations are judged too small by the residuals."""


Sensor = SensorGeometry | SensorModel


def check_observations(
    points_mm: Array, readings_px: Array, sensors: Sequence[Sensor], sigma_px: Array | None
) -> None:
    """Check the shapes and values of known points and their readings.

    Args:
        points_mm: shape (N, 3) [mm].
        readings_px: shape (N, S) [px]; NaN where not seen.
        sensors: the S sensors.
        sigma_px: standard deviations of the readings, shape (N, S) [px]; None: not known.

    Raises:
        InvalidParameter: shapes that do not fit, or a standard deviation out of range.
        NonFiniteValue: a coordinate or reading is NaN or infinite.
        DuplicatePoint: two points have one position.
        ReadingOutsideSensor: a reading lies beyond the sensor's pixels. Each error names the
            point, counted from 1.
    """
    if points_mm.ndim != 2 or points_mm.shape[1] != 3:
        raise InvalidParameter(f"points_mm has the shape {points_mm.shape}; it must be (N, 3)")
    right = (len(points_mm), len(sensors))
    if readings_px.shape != right:
        raise InvalidParameter(
            f"readings_px has the shape {readings_px.shape}; {right[0]} points and {right[1]} "
            f"sensors make {right}"
        )
    for row, axis in np.argwhere(~np.isfinite(points_mm))[:1].tolist():
        raise NonFiniteValue(
            f"point {row + 1} has {'XYZ'[axis]} = {points_mm[row, axis]}; it must be finite",
            point=row + 1,
        )
    for row, column in np.argwhere(np.isinf(readings_px))[:1].tolist():
        raise NonFiniteValue(
            f"the reading of point {row + 1} by sensor {sensors[column].name} is "
            f"{readings_px[row, column]}; it must be finite (leave out what was not seen, in an "
            "array as NaN)",
            point=row + 1,
            sensor=sensors[column].name,
        )
    if sigma_px is not None:
        _check_sigma(sigma_px, readings_px, sensors)
    _check_distinct(points_mm)
    check_inside(readings_px, sensors)


def check_control_points(
    points_mm: Array, readings_px: Array, sensors: Sequence[Sensor], sigma_px: Array | None
) -> None:
    """Check control points and readings, and that each sensor read enough of them.

    Args:
        points_mm: control points, shape (N, 3) [mm].
        readings_px: shape (N, S) [px]; NaN where not seen.
        sensors: the S sensors.
        sigma_px: standard deviations of the readings, shape (N, S) [px]; None: not known.

    Raises:
        InvalidParameter, NonFiniteValue, DuplicatePoint, ReadingOutsideSensor: see
            ``check_observations``.
        TooFewPoints: a sensor read fewer points than it has parameters.
        DegeneratePoints: all points that a sensor read lie in one plane.
        ImplausibleReadings: all readings of a sensor are the same, or those of another sensor.
    """
    check_observations(points_mm, readings_px, sensors, sigma_px)
    measured = np.isfinite(readings_px)
    checked = set()
    for column, sensor in enumerate(sensors):
        rows = measured[:, column]
        if (pattern := rows.tobytes()) not in checked:
            _check_coverage(points_mm[rows], sensor)
            checked.add(pattern)
        _check_varies(readings_px[rows, column], sensor)
    _check_not_copied(readings_px, sensors)


def check_explained(residual_shares: Array, readings_px: Array, sensors: Sequence[Sensor]) -> None:
    """Check that readings are related to the control points.

    Args:
        residual_shares: standard deviation of each sensor's residuals from the best camera,
            relative to that of its readings, shape (S,).
        readings_px: shape (N, S) [px]; NaN where not seen.
        sensors: the S sensors.

    Raises:
        ImplausibleReadings: the first sensor whose readings no camera explains.
    """
    for column in np.flatnonzero(residual_shares > MAX_RESIDUAL_SHARE)[:1].tolist():
        values = readings_px[np.isfinite(readings_px[:, column]), column]
        name, share = sensors[column].name, float(residual_shares[column])
        zeros = int((values == 0.0).sum())
        advice = (
            f"; {zeros} of them are 0: leave the cell empty where a marker was not seen"
            if zeros > 1
            else ""
        )
        raise ImplausibleReadings(
            f"the {len(values)} readings of sensor {name} have nothing to do with the points "
            f"(residual share {share:.2f}: the best camera's residuals over the readings' own "
            f"standard deviation of {values.std():.4g} px; at most {MAX_RESIDUAL_SHARE:g} is "
            "accepted); check that the readings are this sensor's and in the order of the points, "
            f"and that the coordinates are X, Y, Z{advice}",
            sensor=name,
            residual_share=share,
        )


def check_zeros(
    zeros: NDArray[np.intp], contradicted: NDArray[np.bool_], expected_px: Array, sensor: Sensor
) -> None:
    """Check that readings of exactly 0 are not markers that were not seen.

    Args:
        zeros: points whose reading is 0, shape (Z,).
        contradicted: which of them the other readings contradict, shape (Z,).
        expected_px: readings by the camera of the other readings, shape (Z,) [px]; NaN: behind
            the lens.
        sensor: the sensor.

    Raises:
        ImplausibleReadings: the other readings contradict two or more.
    """
    rows = np.flatnonzero(contradicted)
    if len(rows) < 2:
        return
    points = (zeros[rows] + 1).tolist()
    by_point = (
        "behind the lens" if np.isnan(one) else f"at {one:.0f} px"
        for one in expected_px[rows[:3]].tolist()
    )
    more = "" if len(rows) <= 3 else ", ..."
    raise ImplausibleReadings(
        f"{len(rows)} readings of sensor {sensor.name} are 0 though its others put them "
        f"{', '.join(by_point)}{more} (points {', '.join(str(p) for p in points[:3])}{more}): "
        "leave the cell empty where a marker was not seen",
        sensor=sensor.name,
        points=tuple(points),
    )


def check_inside(readings_px: Array, sensors: Sequence[Sensor]) -> None:
    """Check that readings lie on the sensors' pixels.

    Args:
        readings_px: shape (N, S) [px]; NaN where not seen.
        sensors: the S sensors.

    Raises:
        ReadingOutsideSensor: the first reading outside, with its point, counted from 1.
    """
    pixels = np.array([sensor.pixels for sensor in sensors])
    with np.errstate(invalid="ignore"):
        outside = np.argwhere((readings_px < -0.5) | (readings_px > pixels - 0.5))
    for row, column in outside[:1].tolist():
        sensor = sensors[column]
        raise ReadingOutsideSensor(
            f"the reading {readings_px[row, column]:g} px of point {row + 1} lies outside "
            f"sensor {sensor.name}, whose {sensor.pixels} pixels reach from -0.5 to "
            f"{sensor.pixels - 0.5:g} px",
            point=row + 1,
            sensor=sensor.name,
            reading_px=float(readings_px[row, column]),
        )


def _check_coverage(points_mm: Array, sensor: Sensor) -> None:
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


def _check_varies(readings_px: Array, sensor: Sensor) -> None:
    if np.ptp(readings_px) == 0.0:
        raise ImplausibleReadings(
            f"all {len(readings_px)} readings of sensor {sensor.name} are {readings_px[0]:g} px; "
            "markers at different positions cannot all be there: leave the cells empty where "
            "nothing was seen, or leave the sensor out",
            sensor=sensor.name,
        )


def _check_not_copied(readings_px: Array, sensors: Sequence[Sensor]) -> None:
    for first in range(len(sensors) - 1):
        for second in range(first + 1, len(sensors)):
            pair = readings_px[:, [first, second]]
            pair = pair[np.isfinite(pair).all(axis=1)]
            if len(pair) < PARAMETER_COUNT or np.abs(pair[:, 0] - pair[:, 1]).max() > 0.5:
                continue
            if any(
                np.array_equal(np.round(pair, decimals)[:, 0], np.round(pair, decimals)[:, 1])
                and any(np.array_equal(np.round(one, decimals), one) for one in pair.T)
                for decimals in COPY_DECIMALS
            ) or np.array_equal(pair[:, 0], pair[:, 1]):
                names = sensors[first].name, sensors[second].name
                raise ImplausibleReadings(
                    f"the {len(pair)} readings that sensors {names[0]} and {names[1]} have in "
                    "common are the same: one column is a copy of the other; give each sensor its "
                    "own readings, or leave one out",
                    sensors=names,
                )


def _check_sigma(sigma_px: Array, readings_px: Array, sensors: Sequence[Sensor]) -> None:
    if sigma_px.shape != readings_px.shape:
        raise InvalidParameter(
            f"sigma_px has the shape {sigma_px.shape}; the readings have {readings_px.shape}"
        )
    low, high = SIGMA_RANGE_PX
    with np.errstate(invalid="ignore"):
        wrong = np.argwhere(np.isfinite(readings_px) & ~((sigma_px >= low) & (sigma_px <= high)))
    for row, column in wrong[:1].tolist():
        raise InvalidParameter(
            f"the standard deviation of the reading of point {row + 1} by sensor "
            f"{sensors[column].name} is {sigma_px[row, column]} px; it must lie in {low:g} .. "
            f"{high:g} px",
            point=row + 1,
            sensor=sensors[column].name,
        )


def _check_distinct(points_mm: Array) -> None:
    if len(points_mm) < 2:
        return
    gaps = np.diff(np.sort(points_mm, axis=0), axis=0).min(axis=0)
    if gaps.max() > MIN_POINT_DISTANCE_MM:
        return
    # Equal points are neighbours in any order by coordinates; first, as a tree of many equal ones
    # is slow. Points that all but meet need not be.
    order = np.lexsort(points_mm.T)
    apart = np.abs(np.diff(points_mm[order], axis=0)).max(axis=1)
    pairs = np.stack([order[:-1], order[1:]], axis=1)[apart <= MIN_POINT_DISTANCE_MM]
    if not len(pairs):
        distance, nearest = cKDTree(points_mm).query(points_mm, k=[2], p=np.inf)
        near = np.flatnonzero(np.asarray(distance).ravel() <= MIN_POINT_DISTANCE_MM)
        pairs = np.stack([near, np.asarray(nearest).ravel()[near]], axis=1)
    if len(pairs):
        first, second = min(sorted(pair) for pair in pairs.tolist())
        raise DuplicatePoint(
            f"points {first + 1} and {second + 1} have the same position "
            f"{tuple(points_mm[first].tolist())} mm; give each point once, with the mean of its "
            "readings",
            points=(first + 1, second + 1),
        )
