"""Calibrate a device from control points: sensor models with a joint covariance."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from compute.calibration.assessment_result import DistortionEstimate
from compute.calibration.bundle_adjustment.control_point_adjustment import (
    MIN_REDUNDANCY,
    JointFit,
    adjust_control_points,
)
from compute.calibration.mislabels.detector import find_label_errors
from compute.calibration.mislabels.repair import CORRECTIONS, LabelFinding
from compute.calibration.result import Calibration, SensorFit, nested_rows
from compute.calibration.settings import DEFAULTS, CalibrationSettings, preset_terms
from compute.calibration.single_sensor.design_matrix import EquationGroup, effective_parameters
from compute.calibration.single_sensor.distorted_fit import fit_distorted
from compute.calibration.single_sensor.distortion_scale import fit_distortion_scale
from compute.calibration.single_sensor.reading_noise import estimate_noise
from compute.calibration.single_sensor.sensor_fits import (
    SIGMA_FLOOR_PX,
    ControlObservations,
    SensorFits,
    projected_point_sigma,
    residual_sigma,
)
from compute.calibration.single_sensor.undistorted_fit import fit_metric_cameras, fit_undistorted
from compute.camera.model import PARAMETER_COUNT, SensorGeometry, SensorModel, vector3
from compute.camera.observation_checks import (
    UNEXPLAINED_PROBABILITY,
    check_control_points,
    check_zeros,
)
from compute.errors import DegeneratePoints, ImplausibleReadings, LumilineError, NoConvergence
from compute.progress import Progress, no_progress, partial_progress
from compute.reconstruction.triangulation import chi2_limit
from compute.robust_statistics import EFFICIENCY_LOSS

Array = NDArray[np.float64]

QUANTISATION_PX: Final = 1.0 / np.sqrt(12.0)
MAX_NOISE_ITERATIONS: Final = 12
NOISE_TOLERANCE: Final = 0.02
MIN_NOISE_SHARE: Final = 0.1
"""Standard deviation of readings, relative to what the control points' uncertainty does to them,
below which "auto" does not estimate it: the residuals do not tell them apart."""
MIN_CHI2_DOF: Final = 0.5
"""Effective degrees of freedom of a sensor below which chi-square is none: residuals of which a
prior leaves a thousandth say nothing of the noise."""
MAX_ASSUMED_DOF: Final = 2.0
"""Degrees of freedom of all sensors up to which their noise is the prior's more than their own."""
ZERO_SIGMA: Final = 10.0
"""Distance of a reading of 0 from where the sensor's other readings put the marker, in standard
deviations, above which they contradict it."""
ZERO_SHARE: Final = 0.05
"""The same distance relative to the range of the other readings: distortion that the camera does
not describe is below 3 % of it."""


def calibrate(
    points_mm: Array,
    readings_px: Array,
    sensors: Sequence[SensorGeometry],
    sigma_px: Array | None = None,
    settings: CalibrationSettings = DEFAULTS,
    initial_models: Sequence[SensorModel] | None = None,
    progress: Progress = no_progress,
) -> Calibration:
    """Calibrate S sensors from N control points.

    Stages: a normalised linear solution and a grid of others, the seven metric parameters, the
    distortion, and, where the control points have an uncertainty of their own, a joint adjustment
    of all sensors and points. No starting values are needed; random numbers (the start of a
    robust loss) come from a fixed seed, so that results repeat.

    Args:
        points_mm: control points, shape (N, 3) [mm].
        readings_px: readings, shape (N, S) [px]; NaN where a sensor did not see the point.
        sensors: the device's sensors in order; with their pitches where distortion is fitted, as
            far as they are known.
        sigma_px: standard deviations of the readings, shape (N, S) [px]. None: one for each
            sensor, estimated from its residuals.
        settings: distortion, the control points' uncertainty, loss, labels.
        initial_models: cameras from which the search starts too, one a sensor; their distortion
            is ignored. None: no others.
        progress: called with the fraction done and the stage.

    Raises:
        TooFewPoints, UndeterminedParameters: the points leave parameters open.
        DegeneratePoints: the points that a sensor saw lie in one plane, or coincide or line up
            seen along its slit.
        NonFiniteValue, DuplicatePoint, ReadingOutsideSensor, InvalidParameter: a value is wrong.
        ImplausibleReadings: a sensor's readings have nothing to do with the points, are those of
            another sensor, or are 0 where its other readings put the markers elsewhere.
        NoConvergence: no camera was found.
    """
    points = np.asarray(points_mm, dtype=np.float64)
    readings = np.asarray(readings_px, dtype=np.float64)
    sigma = None if sigma_px is None else np.asarray(sigma_px, dtype=np.float64)
    check_control_points(points, readings, sensors, sigma)
    _check_zeros(points, readings, sensors)
    labels: tuple[LabelFinding, ...] = ()
    if settings.labels != "off":
        search = partial_progress(progress, 0.0, 0.05)
        labels = _find_labels(points, readings, sensors, sigma, search)
        correct = CORRECTIONS.get(settings.labels)
        if labels and correct is not None:
            readings, sigma = correct(labels, sensors, readings, sigma)
            check_control_points(points, readings, sensors, sigma)
    observed = ControlObservations.of(points, readings, sensors, sigma)
    try:
        result = _fit(observed, settings, initial_models, progress)
    except (DegeneratePoints, ImplausibleReadings, NoConvergence) as error:
        if not labels:
            raise
        # Report the label errors too: they may be why the fit failed.
        named = "; ".join(_describe(finding) for finding in labels)
        advice = "" if settings.labels != "report" else '; set labels to "repair" or "exclude"'
        raise type(error)(
            f"{error.detail}; labels and readings that look wrong: {named}{advice}", **error.context
        ) from error
    return replace(result, labels=labels)


def _check_zeros(points_mm: Array, readings_px: Array, sensors: Sequence[SensorGeometry]) -> None:
    """Check that no sensor's readings of exactly 0 stand for markers that it did not see.

    Raises:
        ImplausibleReadings: a camera fitted to the sensor's other readings contradicts two or more.
    """
    for column in np.flatnonzero((readings_px == 0.0).sum(axis=0) > 1).tolist():
        sensor = sensors[column]
        values = readings_px[:, [column]]
        zeros = np.flatnonzero(values[:, 0] == 0.0)
        rows = np.isfinite(values[:, 0]) & (values[:, 0] != 0.0)
        points, others = points_mm[rows], values[rows]
        ones = np.ones(others.shape)
        try:
            check_control_points(points, others, [sensor], None)
            models, groups, stack = fit_metric_cameras(points, others, ones, [sensor])
        except LumilineError:
            # Too few others: the fit to all readings must tell.
            continue
        observed = ControlObservations.of(points, others, [sensor], None)
        noise = max(float(residual_sigma(observed, models, ones)[0]), float(QUANTISATION_PX))
        expected, jacobian = stack.project_with_parameter_jacobian(points_mm[zeros])
        cofactor = groups[0].cofactors[0]
        variance = np.einsum("np,pq,nq->n", jacobian[:, 0], cofactor, jacobian[:, 0])
        limit = np.maximum(
            ZERO_SIGMA * noise * np.sqrt(1.0 + variance), ZERO_SHARE * float(np.ptp(others))
        )
        # Behind the lens: NaN.
        contradicted = ~(np.abs(expected[:, 0]) <= limit)
        check_zeros(zeros, contradicted, expected[:, 0], sensor)


def _find_labels(
    points_mm: Array,
    readings_px: Array,
    sensors: Sequence[SensorGeometry],
    sigma_px: Array | None,
    progress: Progress,
) -> tuple[LabelFinding, ...]:
    """Return label errors and outliers of the sensors that have more readings than parameters."""
    redundant = np.flatnonzero(np.isfinite(readings_px).sum(axis=0) > PARAMETER_COUNT)
    if not len(redundant):
        return ()
    sigma = None if sigma_px is None else sigma_px[:, redundant]
    some = [sensors[column] for column in redundant.tolist()]
    return find_label_errors(points_mm, readings_px[:, redundant], some, sigma, progress).findings


def _describe(finding: LabelFinding) -> str:
    sensor = "all sensors" if finding.sensor is None else f"sensor {finding.sensor}"
    points = " and ".join(str(point) for point in finding.points)
    return f"{finding.kind} for {sensor}: {points} (probability {finding.probability:.2g})"


def _fit(
    observed: ControlObservations,
    settings: CalibrationSettings,
    initial_models: Sequence[SensorModel] | None,
    progress: Progress,
) -> Calibration:
    progress(0.05, "cameras without distortion")
    undistorted = fit_undistorted(observed, settings.loss, initial_models)
    weighted = observed
    if settings.position_sigma_mm is not None and observed.sigma_known:
        weighted = observed.with_point_sigma(undistorted.models, settings.position_sigma_mm)
    fits, selection = _fit_distortion(weighted, undistorted, settings, progress)
    progress(0.8, "covariance")
    if settings.position_sigma_mm is None:
        result = assemble_with_exact_points(observed, fits, settings)
    else:
        joint = partial_progress(progress, 0.8, 1.0)
        result = _assemble_with_uncertain_points(
            observed, fits, settings, settings.position_sigma_mm, joint
        )
    progress(1.0, "calibrated")
    return replace(result, distortion=selection)


def _fit_distortion(
    observed: ControlObservations,
    fits: SensorFits,
    settings: CalibrationSettings,
    progress: Progress,
) -> tuple[SensorFits, DistortionEstimate | None]:
    requested = settings.distortion
    models = fits.models
    if requested == "none":
        return fits, None
    if requested == "auto":
        search = partial_progress(progress, 0.1, 0.8)
        point_sigma = None
        if not observed.sigma_known and settings.position_sigma_mm is not None:
            point_sigma = projected_point_sigma(
                models, observed.points_mm, settings.position_sigma_mm
            )
        return fit_distortion_scale(observed, fits, settings.loss, point_sigma, search)
    if isinstance(requested, str):
        terms = (preset_terms(requested),) * len(models)
        selection = DistortionEstimate(requested, "as asked")
    else:
        terms = (requested,) * len(models)
        selection = DistortionEstimate("terms", "as asked")
    progress(0.7, f"distortion {selection.chosen}")
    return fit_distorted(observed, fits, terms, settings.loss, from_subsets=True), selection


def _fit_statistics(
    model: SensorModel,
    points: int,
    residuals_px: Array,
    parameters: float,
    sigma_px: Array | None,
    chi2_terms: Array | None = None,
) -> tuple[SensorFit, float]:
    """Return a sensor's fit statistics and the factor from cofactor to covariance.

    Args:
        model: the fitted camera.
        points: number of control points that the sensor read.
        residuals_px: fitted minus measured readings, those with weight only, shape (N,) [px].
        parameters: effective number of parameters that the residuals have fitted.
        sigma_px: their standard deviations, shape (N,) [px]; None: not known.
        chi2_terms: residuals over sigma for the chi-square test, shape (N,); None: of these.
    """
    dof = len(residuals_px) - parameters
    square_sum = float((residuals_px**2).sum())
    chi2_per_dof, factor = None, 1.0
    source: Literal["given", "residuals", "assumed"]
    if sigma_px is not None:
        source, sigma = "given", float(np.sqrt((sigma_px**2).mean()))
        if dof > MIN_CHI2_DOF:
            terms = residuals_px / sigma_px if chi2_terms is None else chi2_terms
            chi2 = float((terms**2).sum())
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
    rms, largest = float(np.sqrt((residuals_px**2).mean())), float(np.abs(residuals_px).max())
    return SensorFit(model, points, rms, largest, sigma, source, chi2_per_dof), factor


def assemble_with_exact_points(
    observed: ControlObservations, fits: SensorFits, settings: CalibrationSettings
) -> Calibration:
    """Return the calibration of sensors that were fitted one by one to exact points.

    Args:
        observed: control points and readings of S sensors.
        fits: the fitted cameras and the readings' weights.
        settings: the settings of the run, which the result repeats.
    """
    residuals = observed.residuals_px(fits.models if fits.stack is None else fits.stack)
    first = np.cumsum([0, *(model.parameter_count for model in fits.models)])
    groups = fits.equation_groups(observed)
    parameters = _effective_parameters(groups)
    sensor_fits, factors = [], []
    estimated = fits.unit_px if settings.distortion == "auto" else None
    source: Literal["residuals", "assumed"] = "residuals"
    if fits.used(observed).sum() - sum(parameters) <= MAX_ASSUMED_DOF:
        source = "assumed"
    for column, (model, rows) in enumerate(zip(fits.models, fits.used(observed).T, strict=True)):
        sigma = observed.sigma_px[rows, column] if observed.sigma_known else None
        points = int(observed.observed_mask[:, column].sum())
        fit, factor = _fit_statistics(
            model, points, residuals[rows, column], parameters[column], sigma
        )
        if estimated is not None:
            # From all sensors, over all scales of the distortion.
            fit = replace(fit, sigma_px=float(estimated[column]), sigma_source=source)
            factor = float(estimated[column] ** 2)
        sensor_fits.append(fit)
        factors.append(factor * (EFFICIENCY_LOSS if settings.loss == "robust" else 1.0))
    covariance = np.zeros((first[-1], first[-1]))
    for group in groups:
        for sensor, inverse in zip(group.sensors, group.cofactors, strict=True):
            columns = first[sensor] + group.columns
            covariance[columns[:, None], columns] = inverse * factors[sensor]
    return _calibration(observed, fits, settings, sensor_fits, covariance, residuals)


def _effective_parameters(groups: list[EquationGroup]) -> list[float]:
    """Return each sensor's number of parameters that the readings determine."""
    counts = {
        sensor: count
        for group in groups
        for sensor, count in zip(
            group.sensors.tolist(),
            effective_parameters(group.cofactors, group.information).tolist(),
            strict=True,
        )
    }
    return [counts[sensor] for sensor in range(len(counts))]


def _assemble_with_uncertain_points(
    observed: ControlObservations,
    fits: SensorFits,
    settings: CalibrationSettings,
    position_sigma_mm: float,
    progress: Progress,
) -> Calibration:
    """Adjust sensors and uncertain control points jointly and return the calibration."""
    point_sigma = projected_point_sigma(fits.models, observed.points_mm, position_sigma_mm)
    if observed.sigma_known:
        sigma = observed.sigma_px
        joint = adjust_control_points(observed, fits, sigma, position_sigma_mm, progress)
    else:
        pooled = settings.distortion == "auto"
        joint, sigma = _estimate_noise(
            observed, fits, point_sigma, position_sigma_mm, pooled, progress
        )
    total = np.hypot(sigma, point_sigma)
    chi2_terms = observed.residuals_px(joint.models) / total
    with_sigma = replace(observed, sigma_px=total, sigma_known=True)
    adjusted = replace(fits, models=joint.models, unit_px=None, groups=None, stack=None)
    parameters = _effective_parameters(adjusted.equation_groups(with_sigma))
    sensor_fits, factors = [], []
    for column, (model, rows) in enumerate(zip(joint.models, fits.used(observed).T, strict=True)):
        fit, factor = _fit_statistics(
            model,
            int(observed.observed_mask[:, column].sum()),
            joint.residuals_px[rows, column],
            parameters[column],
            sigma[rows, column],
            chi2_terms[rows, column],
        )
        if not observed.sigma_known:
            # Estimated from these residuals: a chi-square test would say nothing.
            fit, factor = replace(fit, sigma_source="residuals", chi2_per_dof=None), 1.0
        assumed = joint.sigma_px[rows, column]
        if (assumed > sigma[rows, column]).any():
            assumed_px = float(np.sqrt((assumed**2).mean()))
            fit = replace(fit, sigma_px=assumed_px, sigma_source="assumed")
        sensor_fits.append(fit)
        factors += [factor**0.5] * model.parameter_count
    covariance = joint.covariance * np.outer(factors, factors)
    result = _calibration(observed, fits, settings, sensor_fits, covariance, joint.residuals_px)
    return replace(result, point_shifts_mm=tuple(vector3(row) for row in joint.shifts_mm))


def _estimate_noise(
    observed: ControlObservations,
    fits: SensorFits,
    point_sigma_px: Array,
    position_sigma_mm: float,
    pooled: bool,
    progress: Progress,
) -> tuple[JointFit, Array]:
    """Adjust, and estimate the readings' noise by variance components (Helmert's method).

    Each iteration sets a sensor's variance to its squared residuals over its redundancy. A sensor
    without redundancy keeps the estimate of ``_noise_without_points``.

    Returns:
        The adjustment, and the readings' standard deviations, shape (N, S) [px].
    """
    first = _noise_without_points(observed, fits, point_sigma_px)
    if pooled and fits.unit_px is not None:
        first = fits.unit_px
    used = fits.used(observed)
    resolved = np.sqrt((np.where(used, point_sigma_px, 0.0) ** 2).sum(axis=0) / used.sum(axis=0))
    lowest = np.maximum(MIN_NOISE_SHARE * resolved if pooled else 0.0, SIGMA_FLOOR_PX)
    first = np.maximum(first, lowest)
    sigma, last = first, None
    for _ in range(MAX_NOISE_ITERATIONS):
        wide = np.broadcast_to(sigma, point_sigma_px.shape)
        joint = adjust_control_points(observed, fits, wide, position_sigma_mm, progress, last)
        last = joint
        variance, dof = (sigma * joint.sigma_ratio) ** 2, joint.redundancy
        if pooled:
            # ``sigma_ratio`` has MIN_REDUNDANCY for less of it.
            size = np.sqrt(variance * np.maximum(dof, MIN_REDUNDANCY))
            # The redundancy falls with the noise, so that small noise is more probable than by
            # these degrees of freedom, and the mean of the variance would be too large.
            used_once = np.ones((1, len(dof)), dtype=np.bool_)
            new = estimate_noise(size[None], used_once, dof).geometric_px
        else:
            # dof - 2: as in ``_fit_statistics``.
            estimated = np.sqrt(variance * dof / np.maximum(dof - 2.0, 1.0))
            new = np.where(dof > MIN_REDUNDANCY, estimated, first)
        new = np.maximum(new, lowest)
        converged = np.abs(new / sigma - 1.0).max() < NOISE_TOLERANCE
        sigma = new
        if converged:
            break
    return joint, wide


def _noise_without_points(
    observed: ControlObservations, fits: SensorFits, point_sigma_px: Array
) -> Array:
    """Return each sensor's noise less the part that the points' uncertainty explains, (S,) [px]."""
    sigma = []
    residuals = observed.residuals_px(fits.models)
    for column, (model, rows) in enumerate(zip(fits.models, fits.used(observed).T, strict=True)):
        count = PARAMETER_COUNT + len(model.terms)
        fit, _ = _fit_statistics(model, int(rows.sum()), residuals[rows, column], count, None)
        if fit.sigma_source == "assumed":
            sigma.append(float(QUANTISATION_PX))
            continue
        explained = float((point_sigma_px[rows, column] ** 2).mean())
        sigma.append(float(np.sqrt(max(fit.sigma_px**2 - explained, (0.5 * fit.sigma_px) ** 2))))
    return np.array(sigma)


def _calibration(
    observed: ControlObservations,
    fits: SensorFits,
    settings: CalibrationSettings,
    sensor_fits: list[SensorFit],
    covariance: Array,
    residuals_px: Array,
) -> Calibration:
    measured = observed.observed_mask
    robust = settings.loss == "robust"
    return Calibration(
        "metric",
        tuple(sensor_fits),
        tuple(tuple(row) for row in covariance.tolist()),
        nested_rows(np.where(measured, residuals_px, np.nan)),
        settings,
        reading_weights=nested_rows(np.where(measured, fits.weights, np.nan)) if robust else None,
    )
