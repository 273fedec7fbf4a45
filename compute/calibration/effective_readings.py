"""Readings that a calibration rests on: labels repaired or left out, outliers without weight."""

import numpy as np
from numpy.typing import NDArray

from compute.calibration.mislabels.repair import exclude, repair
from compute.calibration.result import Calibration
from compute.camera.model import SensorGeometry

Array = NDArray[np.float64]


def repaired_readings(
    calibration: Calibration, readings_px: Array, sigma_px: Array | None = None
) -> tuple[Array, Array | None]:
    """Return readings and deviations (N, S) with the label findings dealt with as the run did.

    Args:
        calibration: of control points; readings of another number of points stay as they are.
        readings_px: their readings as they were given, shape (N, S) [px]; NaN where not seen.
        sigma_px: their deviations, shape (N, S) [px], or None.
    """
    readings = np.asarray(readings_px, dtype=np.float64)
    sigma = None if sigma_px is None else np.asarray(sigma_px, dtype=np.float64)
    policy = "off" if calibration.settings is None else calibration.settings.labels
    own = len(calibration.residuals_px) == len(readings)
    if policy in ("off", "report") or not calibration.labels or not own:
        return readings, sigma
    sensors = [SensorGeometry(model.name, model.pixels) for model in calibration.models]
    return (exclude if policy == "exclude" else repair)(
        calibration.labels, sensors, readings, sigma
    )


def effective_readings(
    calibration: Calibration, readings_px: Array, sigma_px: Array | None = None
) -> tuple[Array, Array | None]:
    """Return readings and deviations (N, S) as the calibration's fit used them; NaN where not.

    Label findings are dealt with as the run did, and what a robust loss gave no weight is left
    out. Arguments are those of ``repaired_readings``.
    """
    readings, sigma = repaired_readings(calibration, readings_px, sigma_px)
    given = calibration.reading_weights
    if given is not None and len(given) == len(readings):
        weights = np.array(given, dtype=np.float64).reshape(readings.shape)
        readings = np.where(weights == 0.0, np.nan, readings)
    return readings, sigma


def count_readings(effective_px: Array, differences_mm: Array) -> int:
    """Return how many readings the reconstructed points rest on.

    Args:
        effective_px: readings that were used, shape (N, S) [px]; NaN where not.
        differences_mm: reconstructed minus given points, shape (N, 3); NaN where there is none.
    """
    return int(np.isfinite(effective_px[np.isfinite(differences_mm).all(axis=1)]).sum())
