"""Reliability of reconstructed points: which errors are found, and what the others do."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import MeasurementModel
from compute.reconstruction.point_batch import PointBatch
from compute.reconstruction.triangulation import INCONSISTENCY_SIGNIFICANCE, reading_variance
from compute.reliability import check_readings, noncentrality

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PointReliability:
    """Reliability of N points, as W. Baarda defines it (1968).

    Args:
        detectable_px: internal reliability: minimal detectable bias of each reading, which the
            chi-square test finds with a probability of 0.8, shape (N, S) [px]; infinite where the
            other readings do not check it, NaN where it is not used.
        external_mm: external reliability: largest shift of the point by an error of that size in
            one reading, shape (N,) [mm]; infinite with three sensors, NaN without a position.
    """

    detectable_px: Array
    external_mm: Array


def point_reliability(
    model: MeasurementModel, points: PointBatch, readings_px: Array, sigma_px: Array
) -> PointReliability:
    """Return the reliability of points, from their redundancy.

    Args:
        model: the cameras, their covariance and the correction table.
        points: N points of these readings.
        readings_px: shape (N, S) [px].
        sigma_px: their standard deviations, shape (N, S) or (S,) [px].
    """
    detectable = np.full(points.used.shape, np.nan)
    external = np.full(len(points), np.nan)
    known = np.flatnonzero(np.isfinite(points.position_mm[:, 0]))
    if len(known) == 0:
        return PointReliability(detectable, external)
    position, used = points.position_mm[known], points.used[known]
    readings = np.where(used, np.asarray(readings_px)[known], 0.0)
    sigma = np.broadcast_to(sigma_px, points.used.shape)[known]
    variance = reading_variance(model, readings, sigma, used, position)
    residual, jacobian = model.residuals(readings, position)
    residual[~used], jacobian[~used] = 0.0, 0.0
    checks = check_readings(jacobian, residual, model.whitening(position, variance, used))
    tests = np.array(
        [
            noncentrality(sensors - 3, INCONSISTENCY_SIGNIFICANCE)
            for sensors in range(len(model) + 1)
        ]
    )
    size = checks.detectable_px(tests[used.sum(axis=1)][:, None])
    shift = np.linalg.norm(checks.influence, axis=1) * np.where(used, size, 0.0)
    # Shifts are by errors of corrected readings; a raw one is stretched by the cubic distortion.
    size = size / np.abs(model.cameras.correction_derivative(readings))
    detectable[known] = np.where(used, size, np.nan)
    external[known] = shift.max(axis=1, initial=0.0)
    return PointReliability(detectable, external)
