"""Calibrate a device: every sensor's model from control points, with a joint covariance."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from compute.calibration.assessment import DistortionSelection
from compute.calibration.checks import check_observations
from compute.calibration.design import cofactor, design, fitted_columns
from compute.calibration.distorted import Slits
from compute.calibration.figures import QUANTISATION_PX, Residuals, sensor_fit
from compute.calibration.joint import JointFit, adjust_with_points, point_spread
from compute.calibration.labels.find import find_label_errors
from compute.calibration.labels.mend import exclude, repair
from compute.calibration.published import published_fits
from compute.calibration.result import Calibration, SensorFit
from compute.calibration.robust import EFFICIENCY_LOSS
from compute.calibration.selection import select_terms
from compute.calibration.sensor_fits import Observed, SensorFits, fit_distorted, fit_undistorted
from compute.calibration.settings import DEFAULTS, CalibrationSettings
from compute.calibration.terms import preset_terms
from compute.camera.model import SensorGeometry, SensorModel, vector3
from compute.camera.stack import CameraStack

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]


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

    "metric" goes by stages: a normalised linear solution and a grid of others, the seven metric
    parameters, the distortion, and, where the control points have an uncertainty of their own,
    all sensors and points together. It needs no starting values and draws no random numbers
    but those of a fixed seed (a robust loss's start).
    "dlt-iterative" is the thesis's [5.1]-[5.12] as published, for comparison; its covariance is
    that of a metric camera with its residuals and leaves out D.

    Args:
        points_mm: control points, shape (N, 3) [mm].
        readings_px: readings, shape (N, S) [px]; NaN where a sensor did not see the point.
        sensors: the device's sensors in order; with their pitches where distortion is fitted, as
            far as they are known.
        sigma_px: standard deviations of the readings, shape (N, S) [px]. None: one deviation
            for each sensor, estimated from its residuals.
        settings: method, distortion, the points' own deviation, loss, labels.
        near: for "metric", cameras that may be close, where it is searched besides.
        progress: called with the fraction done and the stage in words; what it raises passes
            through, which is how a run is cancelled.

    Raises:
        TooFewPoints, DegeneratePoints, NonFiniteValue, DuplicatePoint, ReadingOutsideSensor,
        InvalidParameter, UndeterminedParameters: the observations are not fit for it.
        NoConvergence: no camera was found.
    """
    points = np.asarray(points_mm, dtype=np.float64)
    readings = np.asarray(readings_px, dtype=np.float64)
    deviations = None if sigma_px is None else np.asarray(sigma_px, dtype=np.float64)
    check_observations(points, readings, sensors, deviations)
    labels = None
    if settings.labels != "off":
        _tell(progress, 0.0, "labels")
        labels = find_label_errors(points, readings, sensors, deviations).findings
        if labels and settings.labels != "report":
            mend = exclude if settings.labels == "exclude" else repair
            readings, deviations = mend(labels, sensors, readings, deviations)
            check_observations(points, readings, sensors, deviations)
    seen = np.isfinite(readings)
    observed = Observed(
        points,
        readings,
        np.where(seen, 1.0 if deviations is None else deviations, 1.0),
        deviations is not None,
        tuple(sensors),
    )
    if settings.method != "metric":
        return replace(published_fits(observed, settings, progress), labels=labels or ())
    _tell(progress, 0.0, "cameras without distortion")
    models, weights = fit_undistorted(observed, settings.loss, near)
    staged = _with_point_spread(observed, models, settings.control_sigma_mm)
    fits, selection = _with_distortion(staged, models, weights, settings, near, progress)
    _tell(progress, 0.8, "covariance")
    if settings.control_sigma_mm is None:
        result = _exact_points(observed, fits, settings)
    else:
        result = _uncertain_points(observed, fits, settings, settings.control_sigma_mm, progress)
    _tell(progress, 1.0, "calibrated")
    return replace(result, distortion=selection, labels=labels or ())


def _tell(progress: Progress | None, fraction: float, stage: str) -> None:
    if progress is not None:
        progress(fraction, stage)


def _with_point_spread(
    observed: Observed, models: tuple[SensorModel, ...], control_sigma_mm: float | None
) -> Observed:
    """Return the readings with the control points' uncertainty as part of their deviations."""
    if control_sigma_mm is None or not observed.sigma_known:
        return observed
    spread = np.nan_to_num(point_spread(models, observed.points_mm, control_sigma_mm))
    return replace(observed, sigma_px=np.hypot(observed.sigma_px, spread))


def _with_distortion(
    observed: Observed,
    models: tuple[SensorModel, ...],
    weights: Array,
    settings: CalibrationSettings,
    near: Sequence[SensorModel] | None,
    progress: Progress | None,
) -> tuple[SensorFits, DistortionSelection | None]:
    asked = settings.distortion
    starts = models if near is None else _distorted_near(models, near)
    slits = Slits.of(starts, observed.pitch_um, observed.points_mm, observed.seen)
    if asked == "none":
        return SensorFits(models, weights, slits), None
    if asked == "auto":

        def part(fraction: float, stage: str) -> None:
            _tell(progress, 0.1 + 0.6 * fraction, stage)

        terms, selection = select_terms(observed, models, weights, slits, settings.loss, part)
    else:
        own = preset_terms(asked) if isinstance(asked, str) else asked
        terms = (own,) * len(models)
        selection = DistortionSelection(asked if isinstance(asked, str) else "terms", "as asked")
    _tell(progress, 0.7, f"distortion {selection.chosen}")
    return fit_distorted(observed, models, terms, slits, settings.loss, weights), selection


def _distorted_near(
    models: tuple[SensorModel, ...], near: Sequence[SensorModel]
) -> tuple[SensorModel, ...]:
    """Return the cameras with the distortion of others, whose offsets are to be kept."""
    return tuple(
        replace(model, distortion=other.distortion)
        for model, other in zip(models, near, strict=True)
    )


def _exact_points(
    observed: Observed, fits: SensorFits, settings: CalibrationSettings
) -> Calibration:
    residuals = CameraStack.of(fits.models).project(observed.points_mm) - observed.readings_px
    size = sum(model.parameter_count for model in fits.models)
    covariance = np.zeros((size, size))
    found = []
    first = 0
    for column, model in enumerate(fits.models):
        rows = observed.seen[:, column] & (fits.weights[:, column] > 0.0)
        sigma = observed.sigma_px[rows, column] if observed.sigma_known else None
        values = Residuals(residuals[rows, column], sigma)
        fit, factor = sensor_fit(model, int(observed.seen[:, column].sum()), values)
        if settings.loss == "robust":
            factor *= EFFICIENCY_LOSS
        weights = observed.weights[rows, column]
        offset_sigma = float(fits.slits.prior.sigma_mm[column])
        matrix = design(model, observed.points_mm[rows], weights, offset_sigma)
        own = first + fitted_columns(model)
        covariance[np.ix_(own, own)] = cofactor(matrix) * factor
        first += model.parameter_count
        found.append(fit)
    return Calibration(
        settings.method,
        tuple(found),
        _rows(covariance),
        _readings(residuals, observed.seen),
        settings,
        reading_weights=_robust_weights(observed, fits, settings),
    )


def _uncertain_points(
    observed: Observed,
    fits: SensorFits,
    settings: CalibrationSettings,
    control_sigma_mm: float,
    progress: Progress | None,
) -> Calibration:
    spread = point_spread(fits.models, observed.points_mm, control_sigma_mm)
    sigma = observed.sigma_px
    if not observed.sigma_known:
        sigma = np.broadcast_to(_noise_beside(observed, fits, spread), spread.shape)
        fits = replace(fits, slits=fits.slits.scaled(1.0 / sigma[0]))
    joint = adjust_with_points(
        observed,
        fits,
        sigma,
        control_sigma_mm,
        None if progress is None else lambda done, stage: _tell(progress, 0.8 + 0.2 * done, stage),
    )
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
    return tuple(
        tuple(value if here else None for value, here in zip(row, there, strict=True))
        for row, there in zip(values.tolist(), seen.tolist(), strict=True)
    )


def _robust_weights(
    observed: Observed, fits: SensorFits, settings: CalibrationSettings
) -> tuple[tuple[float | None, ...], ...] | None:
    return _readings(fits.weights, observed.seen) if settings.loss == "robust" else None
