"""From fitted sensors to the calibration that is handed out: figures, covariance, residuals."""

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.design import equation_groups
from compute.calibration.figures import QUANTISATION_PX, Residuals, sensor_fit
from compute.calibration.joint import (
    LEAST_REDUNDANCY,
    JointFit,
    adjust_with_points,
    point_spread,
)
from compute.calibration.result import Calibration, SensorFit
from compute.calibration.robust import EFFICIENCY_LOSS
from compute.calibration.sensor_fits import SIGMA_FLOOR_PX, Observed, SensorFits
from compute.calibration.settings import CalibrationSettings
from compute.camera.model import vector3
from compute.camera.stack import CameraStack

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]

NOISE_TURNS: Final = 12
SETTLED_NOISE: Final = 0.02


def with_exact_points(
    observed: Observed, fits: SensorFits, settings: CalibrationSettings
) -> Calibration:
    """Return the calibration of sensors fitted one by one to points taken as exact."""
    stack = CameraStack.of(fits.models)
    residuals = stack.project(observed.points_mm) - observed.readings_px
    counts = [model.parameter_count for model in fits.models]
    first = np.cumsum([0, *counts])
    covariance = np.zeros((first[-1], first[-1]))
    used = np.where(fits.weights > 0.0, observed.weights, 0.0)
    groups = equation_groups(
        fits.models, observed.points_mm, used, fits.slits.prior.sigma_mm, stack=stack
    )
    factors = []
    found = []
    for column, model in enumerate(fits.models):
        rows = observed.seen[:, column] & (fits.weights[:, column] > 0.0)
        sigma = observed.sigma_px[rows, column] if observed.sigma_known else None
        values = Residuals(residuals[rows, column], sigma)
        fit, factor = sensor_fit(model, int(observed.seen[:, column].sum()), values)
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


def with_uncertain_points(
    observed: Observed,
    fits: SensorFits,
    settings: CalibrationSettings,
    control_sigma_mm: float,
    progress: Progress | None,
) -> Calibration:
    """Return the calibration of sensors and points adjusted together.

    Raises:
        NoConvergence, UndeterminedParameters: see ``adjust_with_points``.
    """
    spread = point_spread(fits.models, observed.points_mm, control_sigma_mm)
    if observed.sigma_known:
        sigma = observed.sigma_px
        joint = adjust_with_points(observed, fits, sigma, control_sigma_mm, progress)
    else:
        joint, sigma = _with_noise(observed, fits, spread, control_sigma_mm, progress)
    given = CameraStack.of(joint.models).project(observed.points_mm) - observed.readings_px
    found, factors = [], []
    for column, model in enumerate(joint.models):
        rows = observed.seen[:, column] & (fits.weights[:, column] > 0.0)
        values = Residuals(
            joint.residuals_px[rows, column],
            sigma[rows, column],
            np.hypot(sigma, spread)[rows, column],
            given[rows, column],
        )
        fit, factor = sensor_fit(model, int(observed.seen[:, column].sum()), values)
        if not observed.sigma_known:
            # The deviation came from these residuals: they cannot contradict it.
            fit, factor = replace(fit, sigma_source="residuals", chi2_per_dof=None), 1.0
        found.append(fit)
        factors += [factor**0.5] * model.parameter_count
    covariance = joint.covariance * np.outer(factors, factors)
    return _joint_result(observed, fits, settings, joint, covariance, found)


def _with_noise(
    observed: Observed,
    fits: SensorFits,
    spread_px: Array,
    control_sigma_mm: float,
    progress: Progress | None,
) -> tuple[JointFit, Array]:
    """Return the adjustment with the sensors' deviations that it shows itself, and these (N, S).

    By variance components (Helmert's): a sensor's squared residuals over its redundancy, again
    and again. Where nothing checks a sensor, what its residuals have beyond the points' spread.
    """
    first = _noise_beside(observed, fits, spread_px)
    sigma = first
    for _ in range(NOISE_TURNS):
        scaled = replace(fits, slits=fits.slits.scaled(1.0 / sigma))
        wide = np.broadcast_to(sigma, spread_px.shape)
        joint = adjust_with_points(observed, scaled, wide, control_sigma_mm, progress)
        tells = joint.redundancy > LEAST_REDUNDANCY
        # As n - 9 for n - 7 of a single sensor: the estimate's own uncertainty included.
        wider = np.sqrt(joint.redundancy / np.maximum(joint.redundancy - 2.0, 1.0))
        shown = np.maximum(sigma * joint.sigma_ratio * wider, SIGMA_FLOOR_PX)
        new = np.where(tells, shown, first)
        settled = np.abs(new / sigma - 1.0).max() < SETTLED_NOISE
        sigma = new
        if settled:
            break
    return joint, wide


def _joint_result(
    observed: Observed,
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


def _noise_beside(observed: Observed, fits: SensorFits, spread_px: Array) -> Array:
    """Return each sensor's deviation without what the points' uncertainty explains, (S,) [px]."""
    sigma = []
    residuals = CameraStack.of(fits.models).project(observed.points_mm) - observed.readings_px
    for column, model in enumerate(fits.models):
        rows = observed.seen[:, column] & (fits.weights[:, column] > 0.0)
        fit, _ = sensor_fit(model, int(rows.sum()), Residuals(residuals[rows, column], None))
        if fit.sigma_source == "assumed":
            sigma.append(float(QUANTISATION_PX))
            continue
        explained = float((spread_px[rows, column] ** 2).mean())
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
    observed: Observed, fits: SensorFits, settings: CalibrationSettings
) -> tuple[tuple[float | None, ...], ...] | None:
    return _readings(fits.weights, observed.seen) if settings.loss == "robust" else None
