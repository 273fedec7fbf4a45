"""Assembly of the Calibration from fitted sensors: fit statistics, covariance, residuals."""

from dataclasses import dataclass, replace
from typing import Final, Literal

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
from compute.calibration.single_sensor.sensor_fits import (
    SIGMA_FLOOR_PX,
    ControlObservations,
    SensorFits,
)
from compute.camera.model import PARAMETER_COUNT, SensorModel, vector3
from compute.camera.observation_checks import UNEXPLAINED_PROBABILITY
from compute.camera.stack import CameraStack
from compute.progress import Progress
from compute.reconstruction.triangulation import chi2_limit
from compute.robust_statistics import EFFICIENCY_LOSS

Array = NDArray[np.float64]

QUANTISATION_PX: Final = 1.0 / np.sqrt(12.0)
MAX_NOISE_ITERATIONS: Final = 12
NOISE_TOLERANCE: Final = 0.02


@dataclass(frozen=True, eq=False)
class Residuals:
    """One sensor's residuals.

    Args:
        values_px: fitted minus measured readings, those with weight only, shape (N,) [px].
        sigma_px: their standard deviations, shape (N,) [px]; None: not known.
        total_sigma_px: for the chi-square test, with the control points' uncertainty, shape (N,)
            [px]; None: ``sigma_px``.
        chi2_values_px: residuals at the given points for that test, shape (N,) [px]; None:
            ``values_px``.
    """

    values_px: Array
    sigma_px: Array | None
    total_sigma_px: Array | None = None
    chi2_values_px: Array | None = None


def fit_statistics(model: SensorModel, seen: int, residuals: Residuals) -> tuple[SensorFit, float]:
    """Return a sensor's fit statistics and the factor from cofactor to covariance.

    Args:
        model: the fitted camera.
        seen: number of control points that the sensor read.
        residuals: of its readings with weight.
    """
    values = residuals.values_px
    terms = 0 if model.distortion is None else len(model.distortion.terms)
    # The offset along the slit is a parameter and its prior an observation: they cancel.
    dof = len(values) - PARAMETER_COUNT - terms
    square_sum = float((values**2).sum())
    chi2_per_dof, factor = None, 1.0
    source: Literal["given", "residuals", "assumed"]
    if residuals.sigma_px is not None:
        source, sigma = "given", float(np.sqrt((residuals.sigma_px**2).mean()))
        if dof > 0:
            compared = values if residuals.chi2_values_px is None else residuals.chi2_values_px
            sigma_px = (
                residuals.sigma_px if residuals.total_sigma_px is None else residuals.total_sigma_px
            )
            chi2 = float(((compared / sigma_px) ** 2).sum())
            chi2_per_dof = chi2 / dof
            # The given standard deviations do not explain the residuals: inflate the covariance.
            if chi2 > chi2_limit(dof, UNEXPLAINED_PROBABILITY):
                factor = chi2_per_dof
    elif dof > 2:
        # dof - 2 allows for the uncertainty of the estimate: squared errors over the covariance
        # then average 7, as with a known standard deviation.
        source, sigma = "residuals", max(float(np.sqrt(square_sum / (dof - 2))), SIGMA_FLOOR_PX)
        factor = sigma**2
    else:
        # Two degrees of freedom or fewer are too few for an estimate.
        residual_sigma_px = float(np.sqrt(square_sum / max(dof, 1)))
        source, sigma = "assumed", max(float(QUANTISATION_PX), residual_sigma_px)
        factor = sigma**2
    fit = SensorFit(
        model,
        seen,
        float(np.sqrt((values**2).mean())),
        float(np.abs(values).max()),
        sigma,
        source,
        chi2_per_dof,
    )
    return fit, factor


def assemble_with_exact_points(
    observed: ControlObservations, fits: SensorFits, settings: CalibrationSettings
) -> Calibration:
    """Return the calibration of sensors that were fitted one by one to exact points.

    Args:
        observed: control points and readings of S sensors.
        fits: the fitted cameras and the readings' weights.
        settings: the settings of the run, which the result repeats.
    """
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
            columns = first[sensor] + group.columns
            covariance[columns[:, None], columns] = inverse * factors[sensor]
    return Calibration(
        "metric",
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
    """Adjust sensors and uncertain control points jointly and return the calibration.

    Args:
        observed: control points and readings of S sensors.
        fits: cameras fitted one by one, from which the adjustment starts.
        settings: the settings of the run, which the result repeats.
        control_sigma_mm: standard deviation of each coordinate of the control points [mm].
        progress: called with the fraction done and the stage.

    Raises:
        NoConvergence, UndeterminedParameters: see ``adjust_control_points``.
    """
    point_sigma = projected_point_sigma(fits.models, observed.points_mm, control_sigma_mm)
    if observed.sigma_known:
        sigma = observed.sigma_px
        joint = adjust_control_points(observed, fits, sigma, control_sigma_mm, progress)
    else:
        joint, sigma = _estimate_noise(observed, fits, point_sigma, control_sigma_mm, progress)
    at_given_points = CameraStack.of(joint.models).project(observed.points_mm)
    at_given_points -= observed.readings_px
    found, factors = [], []
    for column, model in enumerate(joint.models):
        rows = observed.seen[:, column] & (fits.weights[:, column] > 0.0)
        values = Residuals(
            joint.residuals_px[rows, column],
            sigma[rows, column],
            np.hypot(sigma, point_sigma)[rows, column],
            at_given_points[rows, column],
        )
        fit, factor = fit_statistics(model, int(observed.seen[:, column].sum()), values)
        if not observed.sigma_known:
            # Estimated from these residuals: a chi-square test would say nothing.
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
    """Adjust, and estimate the readings' noise by variance components (Helmert's method).

    Each iteration sets a sensor's variance to its squared residuals over its redundancy. A sensor
    without redundancy keeps the estimate of ``_noise_without_points``.

    Returns:
        The adjustment, and the readings' standard deviations, shape (N, S) [px].
    """
    first = _noise_without_points(observed, fits, point_sigma_px)
    sigma = first
    for _ in range(MAX_NOISE_ITERATIONS):
        scaled = replace(fits, lens_offsets=fits.lens_offsets.scaled(1.0 / sigma))
        wide = np.broadcast_to(sigma, point_sigma_px.shape)
        joint = adjust_control_points(observed, scaled, wide, control_sigma_mm, progress)
        checked = joint.redundancy > MIN_REDUNDANCY
        # redundancy - 2: as in ``fit_statistics``.
        wider = np.sqrt(joint.redundancy / np.maximum(joint.redundancy - 2.0, 1.0))
        estimated = np.maximum(sigma * joint.sigma_ratio * wider, SIGMA_FLOOR_PX)
        new = np.where(checked, estimated, first)
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
        "metric",
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
    """Return each sensor's noise less the part that the points' uncertainty explains, (S,) [px]."""
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
        tuple(value if read else None for value, read in zip(row, row_seen, strict=True))
        for row, row_seen in zip(values.tolist(), seen.tolist(), strict=True)
    )


def _robust_weights(
    observed: ControlObservations, fits: SensorFits, settings: CalibrationSettings
) -> tuple[tuple[float | None, ...], ...] | None:
    return _readings(fits.weights, observed.seen) if settings.loss == "robust" else None
