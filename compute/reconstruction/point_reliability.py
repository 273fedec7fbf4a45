"""Internal reliability of reconstructed points: the smallest error of a reading that is found."""

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import MeasurementModel
from compute.reconstruction.point_batch import PointBatch
from compute.reconstruction.triangulation import noncentralities, reading_variance
from compute.reliability import check_readings

Array = NDArray[np.float64]


def detectable_errors(
    model: MeasurementModel, points: PointBatch, readings_px: Array, sigma_px: Array
) -> Array:
    """Return the minimal detectable bias of each reading of N points, shape (N, S) [px].

    W. Baarda's internal reliability (1968): the error that the chi-square test finds with a
    probability of 0.8; infinite where the other readings do not check it, NaN where it is not used.

    Args:
        model: the cameras, their covariance and the correction table.
        points: N points of these readings.
        readings_px: shape (N, S) [px].
        sigma_px: their standard deviations, shape (N, S) or (S,) [px].
    """
    detectable = np.full(points.used.shape, np.nan)
    known = np.flatnonzero(np.isfinite(points.position_mm[:, 0]))
    if len(known) == 0:
        return detectable
    position, used = points.position_mm[known], points.used[known]
    readings = np.where(used, np.asarray(readings_px)[known], 0.0)
    sigma = np.broadcast_to(sigma_px, points.used.shape)[known]
    variance = reading_variance(model, readings, sigma, used, position)
    residual, jacobian = model.residuals(readings, position)
    residual[~used], jacobian[~used] = 0.0, 0.0
    checks = check_readings(jacobian, residual, model.whitening(position, variance, used))
    size = checks.detectable_px(noncentralities(used.shape[1])[used.sum(axis=1)][:, None])
    # A raw reading is stretched by the cubic distortion.
    size = size / np.abs(model.cameras.correction_derivative(readings))
    detectable[known] = np.where(used, size, np.nan)
    return detectable
