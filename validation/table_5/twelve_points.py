"""The detector of Figure 5.2 and the 12 points of Test 5.1, for Tables 5.1 to 5.4."""

from dataclasses import dataclass
from functools import cache
from math import sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from compute.calibration.calibrate import calibrate
from compute.camera.model import SensorGeometry, SensorModel
from validation.thesis_data import LINEAR_CCD, load_cameras, load_test
from validation.thesis_methods.dlt import model_from_collinearity

Array = NDArray[np.float64]

PRINCIPAL_DISTANCE_MM: Final = 32.0
"""As calibrated from the 12 points; Test 5.2 has 37."""


@dataclass(frozen=True, eq=False)
class TwelvePoints:
    """The 12 points of Test 5.1 and their printed readings, in pixels."""

    points_mm: Array
    readings_px: Array
    sensors: tuple[SensorGeometry, ...]


@cache
def twelve_points() -> TwelvePoints:
    """Load Test 5.1."""
    test = load_test("5.1")
    readings = [scale.to_px(test.readings_mm[:, k]) for k, scale in enumerate(LINEAR_CCD)]
    return TwelvePoints(
        test.points_mm, np.column_stack(readings), tuple(scale.geometry for scale in LINEAR_CCD)
    )


@cache
def noise_px() -> float:
    """Return the deviation of a reading that the residuals of Test 5.1 speak of [px]."""
    data = twelve_points()
    fits = calibrate(data.points_mm, data.readings_px, data.sensors).sensors
    squares = sum(fit.rms_px**2 * fit.points for fit in fits)
    return float(sqrt(squares / sum(fit.points - 7 for fit in fits)))


@cache
def detector() -> tuple[SensorModel, ...]:
    """Return the four sensors of Figure 5.2 as calibrated from the 12 points.

    Not the cameras of Test 5.2: sensors 3 and 4 read along the other diagonal there, which puts
    their lenses 18 mm off the middle in the direction they measure, instead of 97 and 99 mm.
    """
    data = twelve_points()
    return calibrate(data.points_mm, data.readings_px, data.sensors).models


def lever_mm(readings_mm: Array) -> Array:
    """Return how far off the middle the lenses of Tests 5.1 and 5.2 lie as they measure [mm].

    By point 1, which lies ahead of the middle at 1,500 mm: its readings (4,), seen from sensor 2
    there, over the principal distance that the thesis set up.
    """
    return np.asarray((readings_mm - readings_mm[1]) / PRINCIPAL_DISTANCE_MM * 1500.0)


def rotated(model: SensorModel, name: str, angle_deg: float, about_mm: Array) -> SensorModel:
    """Return a sensor carried around a point by a turn about the world's Z."""
    turn = Rotation.from_euler("z", angle_deg, degrees=True).as_matrix()
    rotation = model.rotation @ turn.T
    # A point X of the scene is seen as turn' (X - about) + about was before.
    shift = about_mm - turn.T @ about_mm
    x, y, z = Rotation.from_matrix(rotation).as_rotvec().tolist()
    return SensorModel(
        name,
        model.pixels,
        model.principal_distance_px,
        model.principal_point_px,
        (x, y, z),
        model.offset_x_mm + float(model.rotation[0] @ shift),
        model.offset_z_mm + float(model.rotation[2] @ shift),
    )


def set_up() -> tuple[SensorModel, ...]:
    """Return the cameras of Test 5.2."""
    centre = twelve_points().points_mm.mean(axis=0)
    return tuple(
        model_from_collinearity(camera.in_pixels(scale.pitch_mm), scale.geometry, centre)
        for camera, scale in zip(load_cameras("5.2"), LINEAR_CCD, strict=True)
    )
