"""The moving bar of Tables 6.1 and 6.2: generated readings and reconstructions.

Figures 5.6 and 5.5 and Table 5.8, which chapter 6 names, are Figures 5.9 and 5.8 and Table 5.10.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.calibrate import calibrate
from compute.calibration.result import AxisErrors
from compute.camera.stack import CameraStack
from compute.reconstruction.triangulation import triangulate_linear
from validation.section_6.rotating_bar import BAR_MM, RATE_HZ, STILL_FRAMES, TURN_S
from validation.table_5.error_statistics import STATISTICS, statistics_of
from validation.thesis_data import LONG_DFW_V500, csv_rows, generate_readings, load_test
from validation.thesis_methods.dlt import (
    CollinearityParameters,
    model_from_collinearity,
    model_from_matrix,
)
from validation.thesis_methods.iterative_dlt import iterative_dlt

Array = NDArray[np.float64]
Cameras = tuple[CollinearityParameters, ...]

PRINTED_LENGTH_MM: Final = -0.024
"""Section 6.3: the average error of the distance between the markers."""
PRINTED_ANGLE_DEG: Final = 0.0379
"""Section 6.3: the average error of the angular position."""
FRAMES: Final = {"3 m": "5.5", "1 m": "5.6"}
"""The test that has the frame at this distance."""


@dataclass(frozen=True, eq=False)
class Bar:
    """Both markers at rest, and over one turn.

    Args:
        centre_mm: where the bar turns, shape (3,).
        angle_rad: of the first marker, shape (N,).
        points_mm: shape (N, 2, 3).
    """

    centre_mm: Array
    angle_rad: Array
    points_mm: Array


@cache
def bar(distance: str) -> Bar:
    """Return the bar in the middle of the frame at "3 m" or "1 m"; where it was is not said."""
    frame = load_test(FRAMES[distance]).points_mm
    centre = (frame.min(axis=0) + frame.max(axis=0)) / 2.0
    turning = 2.0 * np.pi * np.arange(round(TURN_S * RATE_HZ) + 1) / (TURN_S * RATE_HZ)
    angle = np.concatenate([np.zeros(STILL_FRAMES), turning])
    outwards = np.column_stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
    radius = np.array([BAR_MM / 2.0, -BAR_MM / 2.0])
    return Bar(centre, angle, centre + radius[:, None] * outwards[:, None])


def rounded(readings_mm: Array, digits: int, shift_mm: Array) -> Array:
    """Return readings (N, 4) rounded to so many decimals, on a grid that is shifted (4,) [mm]."""
    return np.asarray(np.round(readings_mm + shift_mm, digits) - shift_mm)


def by_dlt(
    known_mm: Array, known_readings_mm: Array, readings_mm: Array, *, normalised: bool = False
) -> Array:
    """Return points (N, 3) by [5.1]-[5.15], calibrated from known points (K, 3)."""
    known = _pixels(known_readings_mm)
    models = []
    for index, scale in enumerate(LONG_DFW_V500):
        fit = iterative_dlt(known_mm, known[:, index], scale.name, normalised=normalised)
        models.append(
            model_from_matrix(fit.matrix, scale.geometry, known_mm.mean(axis=0), fit.cubic_per_px2)
        )
    stack = CameraStack.of(models)
    return triangulate_linear(stack, stack.add_cubic_term(_pixels(readings_mm)))


def by_metric(known_mm: Array, known_readings_mm: Array, readings_mm: Array) -> Array:
    """Return points (N, 3) by the metric calibration from known points (K, 3)."""
    geometry = [scale.geometry for scale in LONG_DFW_V500]
    models = calibrate(known_mm, _pixels(known_readings_mm), geometry).models
    return triangulate_linear(CameraStack.of(models), _pixels(readings_mm))


def by_known(cameras: Cameras, readings_mm: Array, seen_mm: Array) -> Array:
    """Return points (N, 3) by [5.22]-[5.24] with the cameras known, which see ``seen_mm``."""
    models = []
    for camera, scale in zip(cameras, LONG_DFW_V500, strict=True):
        from_edge = replace(camera, p0=camera.p0 + scale.before_mm)
        models.append(
            model_from_collinearity(from_edge.in_pixels(scale.pitch_mm), scale.geometry, seen_mm)
        )
    return triangulate_linear(CameraStack.of(models), _pixels(readings_mm))


def generated(cameras: Cameras, points_mm: Array) -> Array:
    """Return readings of points (..., 3) by [5.18]-[5.19], shape (N, 4) [mm]."""
    return generate_readings(cameras, points_mm.reshape(-1, 3))


def statistics(found_mm: Array, of: Bar) -> Array:
    """Return the five statistics of X, Y, Z of points (N, 3), shape (5, 3) [mm]."""
    return statistics_of(AxisErrors.of(found_mm - of.points_mm.reshape(-1, 3)))


def length_and_angle(found_mm: Array, of: Bar) -> tuple[float, float]:
    """Return the mean error of the bar's length [mm], and of the markers' angles [deg].

    The angle of each marker about the centre, in the plane of X and Y, without its sign.
    """
    found = found_mm.reshape(of.points_mm.shape)
    length = np.linalg.norm(found[:, 0] - found[:, 1], axis=1) - BAR_MM
    away = found - of.centre_mm
    angle = np.arctan2(away[..., 1], away[..., 0]) - of.angle_rad[:, None] - [0.0, np.pi]
    error = np.abs(np.angle(np.exp(1j * angle)))
    return float(length.mean()), float(np.rad2deg(error.mean()))


def kinematics_along_x(found_mm: Array, of: Bar) -> tuple[float, float]:
    """Return RMS errors of velocity and acceleration along X by differences, of the first marker.

    Beside the differences of its true places, [mm/s] and [mm/s^2].
    """
    off = (found_mm.reshape(of.points_mm.shape) - of.points_mm)[STILL_FRAMES:, 0, 0]
    velocity, acceleration = np.diff(off) * RATE_HZ, np.diff(off, 2) * RATE_HZ**2
    return float(np.sqrt((velocity**2).mean())), float(np.sqrt((acceleration**2).mean()))


@cache
def printed(table: str, half: str) -> Array:
    """Return the five statistics of X, Y, Z of a half of Table 6.1 or 6.2, shape (5, 3) [mm]."""
    found = {
        row["statistic"]: [float(row[f"{axis}_mm"]) for axis in "XYZ"]
        for row in csv_rows("chapter_6_errors.csv")
        if row["table"] == table and row["set"] == half
    }
    return np.array([found[statistic] for statistic in STATISTICS])


def root_mean_square(values: Sequence[Array]) -> Array:
    """Return the root of the mean of squares, element by element."""
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=0)))


def _pixels(readings_mm: Array) -> Array:
    return np.column_stack(
        [scale.to_px(readings_mm[:, index]) for index, scale in enumerate(LONG_DFW_V500)]
    )
