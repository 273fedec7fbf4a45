"""How well a calibration reproduces control points: fitted, and points that it never saw."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from compute.calibration.result import Calibration
from compute.calibration.run import calibrate
from compute.calibration.settings import DEFAULTS, CalibrationSettings
from compute.calibration.weights import reading_sigma
from compute.camera.model import SensorGeometry
from compute.errors import LumilineError
from compute.reconstruction.points import reconstruct

Array = NDArray[np.float64]


def fitted_errors(
    calibration: Calibration, points_mm: Array, readings_px: Array, sigma_px: Array | None = None
) -> Array:
    """Reconstruct the control points and return reconstructed minus given, shape (N, 3) [mm].

    As any readings are reconstructed, with the calibration's covariance. NaN for a point that
    fewer than three sensors saw. The sign is the thesis's (Appendix F).
    """
    sigma = reading_sigma(calibration, readings_px, sigma_px)
    covariance = np.array(calibration.covariance)
    found = reconstruct(calibration.models, readings_px, sigma, covariance)
    return found.position_mm - points_mm


def leave_one_out(
    points_mm: Array,
    readings_px: Array,
    sensors: Sequence[SensorGeometry],
    sigma_px: Array | None = None,
    settings: CalibrationSettings = DEFAULTS,
) -> Array:
    """Calibrate N times without one point and return its errors, shape (N, 3) [mm].

    The metric search starts from the calibration with all points: one point less moves the
    minimum, not by much. NaN where the rest does not calibrate every sensor, or fewer than
    three sensors saw the point.
    """
    errors = np.full(points_mm.shape, np.nan)
    near = None
    if settings.method == "metric":
        near = calibrate(points_mm, readings_px, sensors, sigma_px, settings).models
    for index in range(len(points_mm)):
        rest = np.arange(len(points_mm)) != index
        try:
            calibration = calibrate(
                points_mm[rest],
                readings_px[rest],
                sensors,
                None if sigma_px is None else sigma_px[rest],
                settings,
                near,
            )
        except LumilineError:
            continue
        one = slice(index, index + 1)
        errors[one] = fitted_errors(
            calibration,
            points_mm[one],
            readings_px[one],
            None if sigma_px is None else sigma_px[one],
        )
    return errors
