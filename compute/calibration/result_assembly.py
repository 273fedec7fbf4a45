"""From fitted sensors to the calibration that is handed out: figures, covariance, residuals."""

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.control_point_adjustment import (
    MIN_REDUNDANCY,
    JointFit,
    adjust_control_points,
    projected_point_sigma,
)
from compute.calibration.result import Calibration, SensorFit
from compute.calibration.settings import CalibrationSettings
from compute.calibration.single_sensor.design_matrix import equation_groups
from compute.calibration.single_sensor.fit_statistics import (
    QUANTISATION_PX,
    Residuals,
    fit_statistics,
)
from compute.calibration.single_sensor.m_estimators import EFFICIENCY_LOSS
from compute.calibration.single_sensor.sensor_fits import (
    SIGMA_FLOOR_PX,
    ControlObservations,
    SensorFits,
)
from compute.camera.model import vector3
from compute.camera.stack import CameraStack

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]

MAX_NOISE_ITERATIONS: Final = 12
NOISE_TOLERANCE: Final = 0.02


def assemble_with_exact_points(
    observed: ControlObservations, fits: SensorFits, settings: CalibrationSettings
) -> Calibration:
    """Return the calibration of sensors fitted one by one to points taken as exact."""
    stack = CameraStack.of(fits.models)
    residuals = stack.project(observed.points_mm) - observed.readings_px
    counts = [model.parameter_count for model in fits.models]
    first = np.cumsum([0, *counts])
    covariance = np.zeros((first[-1], first[-1]))
    used = np.where(fits.weights > 0.0, observed.weights, 0.0)
    groups = equation_groups(
        fits.models, observed.points_mm, used, fits.lens_offsets.prior.sigma_mm, stack=stack
    )
    factors = []
    found = []
    for column, model in enumerate(fits.models):
        rows = observed.seen[:, column] & (fits.weights[:, column] > 0.0)
        sigma = observed.sigma_px[rows, column] if observed.sigma_known else None
        values = Residuals(residuals[rows, column], sigma)
        fit, factor = fit_statistics(model, int(observed.seen[:, column].sum()), values)
        if settings.loss == "robust":
            factor *= EFFICIENCY_LOSS
        factors.append(factor)
        found.append(fit)
    for group in groups:
        for sensor, inverse in zip(group.sensors, group.cofactors, strict=True):
            own = first[sensor] + group.columns
            covariance[own[:, None], own] = inverse * factors[sensor]
    return Calibration(
        settings.method,
        tuple(found),
        _rows(covariance),
        _readings(residuals, observed.seen),
        settings,
        reading_weights=_robust_weights(observed, fits, settings),
    )


def assemble_with_uncertain_points(
    observed: ControlObservations,
    fits: SensorFits,
    settings: CalibrationSettings,
    control_sigma_mm: float,
    progress: Progress | None,
) -> Calibration:
    """Return the calibration of sensors and points adjusted together.

    Raises:
        NoConvergence, UndeterminedParameters: see ``adjust_control_points``.
    """
    point_sigma = projected_point_sigma(fits.models, observed.points_mm, control_sigma_mm)
    if observed.sigma_known:
        sigma = observed.sigma_px
        joint = adjust_control_points(observed, fits, sigma, control_sigma_mm, progress)
    else:
        joint, sigma = _estimate_noise(observed, fits, point_sigma, control_sigma_mm, progress)
    given = CameraStack.of(joint.models).project(observed.points_mm) - observed.readings_px
    found, factors = [], []
    for column, model in enumerate(joint.models):
        rows = observed.seen[:, column] & (fits.weights[:, column] > 0.0)
        values = Residuals(
            joint.residuals_px[rows, column],
            sigma[rows, column],
            np.hypot(sigma, point_sigma)[rows, column],
            given[rows, column],
        )
        fit, factor = fit_statistics(model, int(observed.seen[:, column].sum()), values)
        if not observed.sigma_known:
            # The deviation came from these residuals: they cannot contradict it.
            fit, factor = replace(fit, sigma_source="residuals", chi2_per_dof=None), 1.0
        found.append(fit)
        factors += [factor**0.5] * model.parameter_count
    covariance = joint.covariance * np.outer(factors, factors)
    return _assemble(observed, fits, settings, joint, covariance, found)


def _estimate_noise(
    observed: ControlObservations,
    fits: SensorFits,
    point_sigma_px: Array,
    control_sigma_mm: float,
    progress: Progress | None,
) -> tuple[JointFit, Array]:
    """Return the adjustment with the sensors' deviations that it shows itself, and these (N, S).

    By variance components (Helmert's): a sensor's squared residuals over its redundancy, again
    and again. Where nothing checks a sensor, what its residuals have beyond the points' spread.
    """
    first = _noise_without_points(observed, fits, point_sigma_px)
    sigma = first
    for _ in range(MAX_NOISE_ITERATIONS):
        scaled = replace(fits, lens_offsets=fits.lens_offsets.scaled(1.0 / sigma))
        wide = np.broadcast_to(sigma, point_sigma_px.shape)
        joint = adjust_control_points(observed, scaled, wide, control_sigma_mm, progress)
        tells = joint.redundancy > MIN_REDUNDANCY
        # As n - 9 for n - 7 of a single sensor: the estimate's own uncertainty included.
        wider = np.sqrt(joint.redundancy / np.maximum(joint.redundancy - 2.0, 1.0))
        estimated = np.maximum(sigma * joint.sigma_ratio * wider, SIGMA_FLOOR_PX)
        new = np.where(tells, estimated, first)
        converged = np.abs(new / sigma - 1.0).max() < NOISE_TOLERANCE
        sigma = new
        if converged:
            break
    return joint, wide


def _assemble(
    observed: ControlObservations,
    fits: SensorFits,
    settings: CalibrationSettings,
    joint: JointFit,
    covariance: Array,
    found: list[SensorFit],
) -> Calibration:
    return Calibration(
        settings.method,
        tuple(found),
        _rows(covariance),
        _readings(joint.residuals_px, observed.seen),
        settings,
        reading_weights=_robust_weights(observed, fits, settings),
        point_shifts_mm=tuple(vector3(row) for row in joint.shifts_mm),
    )


def _noise_without_points(
    observed: ControlObservations, fits: SensorFits, point_sigma_px: Array
) -> Array:
    """Return each sensor's deviation without what the points' uncertainty explains, (S,) [px]."""
    sigma = []
    residuals = CameraStack.of(fits.models).project(observed.points_mm) - observed.readings_px
    for column, model in enumerate(fits.models):
        rows = observed.seen[:, column] & (fits.weights[:, column] > 0.0)
        fit, _ = fit_statistics(model, int(rows.sum()), Residuals(residuals[rows, column], None))
        if fit.sigma_source == "assumed":
            sigma.append(float(QUANTISATION_PX))
            continue
        explained = float((point_sigma_px[rows, column] ** 2).mean())
        sigma.append(float(np.sqrt(max(fit.sigma_px**2 - explained, (0.5 * fit.sigma_px) ** 2))))
    return np.array(sigma)


def _rows(matrix: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in matrix.tolist())


def _readings(values: Array, seen: NDArray[np.bool_]) -> tuple[tuple[float | None, ...], ...]:
    """Return values (N, S) with None where there was no reading."""
    if seen.all():
        return _rows(values)
    return tuple(
        tuple(value if here else None for value, here in zip(row, there, strict=True))
        for row, there in zip(values.tolist(), seen.tolist(), strict=True)
    )


def _robust_weights(
    observed: ControlObservations, fits: SensorFits, settings: CalibrationSettings
) -> tuple[tuple[float | None, ...], ...] | None:
    return _readings(fits.weights, observed.seen) if settings.loss == "robust" else None
