"""The readings that a calibration rests on, where labels were left out or mended."""

import numpy as np
from numpy.typing import NDArray

from compute.calibration.result import Calibration
from compute.camera.stack import CameraStack

Array = NDArray[np.float64]


def used_readings(calibration: Calibration, points_mm: Array, readings_px: Array) -> Array:
    """Return the readings as the calibration took them, shape (N, S) [px].

    Those given, unless wrong labels were left out (NaN) or mended (the reading that was taken in
    its place, from the residual).
    """
    settings = calibration.settings
    acted = settings is not None and settings.labels in ("exclude", "repair")
    if not (acted and calibration.labels) or len(calibration.residuals_px) != len(points_mm):
        return readings_px
    residuals = np.array(
        [[np.nan if value is None else value for value in row] for row in calibration.residuals_px],
        dtype=np.float64,
    ).reshape(readings_px.shape)
    places = points_mm
    if calibration.point_shifts_mm is not None:
        places = points_mm + np.array(calibration.point_shifts_mm)
    taken = CameraStack.of(calibration.models).project(places) - residuals
    # What was not touched stays the very number that was given.
    same = np.isclose(taken, readings_px, rtol=0.0, atol=1e-6)
    return np.where(same, readings_px, taken)
