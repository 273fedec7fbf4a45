"""Calibrate a device: every sensor's model from control points, with a joint covariance."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from compute.calibration.checks import check_observations
from compute.calibration.iterative import iterative_dlt
from compute.calibration.metric import RefinedSensor, at_solution, refine
from compute.calibration.result import Calibration, SensorFit
from compute.calibration.settings import DEFAULTS, CalibrationSettings
from compute.camera.dlt import model_from_matrix
from compute.camera.model import PARAMETER_COUNT, SensorGeometry, SensorModel
from compute.errors import InvalidParameter, NoConvergence
from compute.reconstruction.points import chi2_limit

Array = NDArray[np.float64]

Progress = Callable[[float, str], None]

SIGMA_FLOOR_PX = 1e-6
"""Smallest deviation estimated from residuals: exact data still leave rounding."""
QUANTISATION_PX = 1.0 / np.sqrt(12.0)
UNEXPLAINED_PROBABILITY = 0.01
"""Chance that right deviations are taken for too small."""


def calibrate(
    points_mm: Array,
    readings_px: Array,
    sensors: Sequence[SensorGeometry],
    sigma_px: Array | None = None,
    settings: CalibrationSettings = DEFAULTS,
    near: Sequence[SensorModel] | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate S sensors from N control points.

    "metric" solves a normalised DLT and refines the seven metric parameters geometrically.
    "dlt-iterative" is the thesis's [5.1]-[5.12] as published, for comparison; its covariance is
    that of a metric camera with its residuals and leaves out D.

    Args:
        points_mm: control points, shape (N, 3) [mm].
        readings_px: readings, shape (N, S) [px]; NaN where a sensor did not see the point.
        sensors: the device's sensors in order.
        sigma_px: standard deviations of the readings, shape (N, S) [px]. None: one deviation
            for each sensor, estimated from its residuals.
        settings: method, distortion, the points' own deviation, loss, labels.
        near: for "metric", cameras known to be close, from which alone it is searched then.
        progress: called with the fraction done and the stage in words; what it raises passes
            through, which is how a run is cancelled.

    Raises:
        TooFewPoints, DegeneratePoints, NonFiniteValue, DuplicatePoint, ReadingOutsideSensor,
        InvalidParameter: the observations are not fit for it.
        NoConvergence: no camera was found.
    """
    points = np.asarray(points_mm, dtype=np.float64)
    readings = np.asarray(readings_px, dtype=np.float64)
    deviations = None if sigma_px is None else np.asarray(sigma_px, dtype=np.float64)
    check_observations(points, readings, sensors, deviations)
    if settings != CalibrationSettings(settings.method):
        raise InvalidParameter(f"{settings} is not there yet")
    fits = []
    residuals = np.full(readings.shape, np.nan)
    covariance = np.zeros((PARAMETER_COUNT * len(sensors),) * 2)
    for column, sensor in enumerate(sensors):
        if progress is not None:
            progress(column / len(sensors), f"sensor {sensor.name}")
        seen = np.isfinite(readings[:, column])
        sigma = None if deviations is None else deviations[seen, column]
        unit = np.ones(int(seen.sum())) if sigma is None else sigma
        if settings.method == "metric":
            start = near[column] if near else None
            refined = refine(points[seen], readings[seen, column], unit, sensor, start)
        else:
            refined = _published(points[seen], readings[seen, column], unit, sensor)
        fit, variance = _assess(refined, sigma)
        block = slice(column * PARAMETER_COUNT, (column + 1) * PARAMETER_COUNT)
        covariance[block, block] = refined.cofactor * variance
        residuals[seen, column] = refined.residuals_px
        fits.append(fit)
    return Calibration(
        settings.method,
        tuple(fits),
        tuple(tuple(row) for row in covariance.tolist()),
        tuple(
            tuple(None if np.isnan(value) else float(value) for value in row) for row in residuals
        ),
        settings,
    )


def _published(
    points_mm: Array, readings_px: Array, sigma_px: Array, sensor: SensorGeometry
) -> RefinedSensor:
    """Fit as the thesis does, then look at the result as at any camera."""
    fitted = iterative_dlt(points_mm, readings_px, sensor.name)
    depth = fitted.matrix[1, :3] @ points_mm.T + fitted.matrix[1, 3]
    if not ((depth > 0).all() or (depth < 0).all()):
        raise NoConvergence(
            f"sensor {sensor.name}: the iterative DLT ended with control points on both sides "
            "of the lens; use the metric method",
            sensor=sensor.name,
        )
    model = model_from_matrix(
        fitted.matrix, sensor, points_mm.mean(axis=0), cubic_per_px2=fitted.cubic_per_px2
    )
    refined = at_solution(model, points_mm, readings_px, sigma_px)
    return replace(refined, iteration_change_px=fitted.change_px)


def _assess(refined: RefinedSensor, sigma_px: Array | None) -> tuple[SensorFit, float]:
    """Return the fit's figures and the factor from cofactor to covariance."""
    residuals = refined.residuals_px
    freedom = len(residuals) - PARAMETER_COUNT
    square_sum = float((residuals**2).sum())
    chi2_per_dof, factor = None, 1.0
    source: Literal["given", "residuals", "assumed"]
    if sigma_px is not None:
        source, sigma = "given", float(np.sqrt((sigma_px**2).mean()))
        if freedom > 0:
            chi2 = float(((residuals / sigma_px) ** 2).sum())
            chi2_per_dof = chi2 / freedom
            # Residuals that the given deviations do not explain: the covariance grows with them.
            if chi2 > chi2_limit(freedom, UNEXPLAINED_PROBABILITY):
                factor = chi2_per_dof
    elif freedom > 2:
        # n - 9 instead of n - 7: the estimate's own uncertainty included, so that errors squared
        # over the covariance average 7, as they would with a known deviation.
        source, sigma = "residuals", max(float(np.sqrt(square_sum / (freedom - 2))), SIGMA_FLOOR_PX)
        factor = sigma**2
    else:
        # One or two residuals more than parameters say too little.
        spread = float(np.sqrt(square_sum / max(freedom, 1)))
        source, sigma = "assumed", max(float(QUANTISATION_PX), spread)
        factor = sigma**2
    fit = SensorFit(
        refined.model,
        len(residuals),
        float(np.sqrt((residuals**2).mean())),
        float(np.abs(residuals).max()),
        sigma,
        source,
        chi2_per_dof,
        refined.iteration_change_px,
    )
    return fit, factor
