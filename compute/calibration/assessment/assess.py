"""Assessed calibration: calibrate, cross-validate (leave points out), diagnose."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from compute.calibration.assessment.diagnosis import diagnose
from compute.calibration.calibrate import assemble_with_exact_points, calibrate
from compute.calibration.result import (
    AxisErrors,
    Calibration,
    CrossValidation,
    count_readings,
    effective_readings,
    measurement_sigma,
    prior_strength,
    repaired_readings,
)
from compute.calibration.settings import DEFAULTS, CalibrationSettings
from compute.calibration.single_sensor.design_matrix import undetermined_sensors
from compute.calibration.single_sensor.lens_prior import LensPrior
from compute.calibration.single_sensor.sensor_fits import ControlObservations, SensorFits
from compute.camera.model import PARAMETER_COUNT, SensorGeometry, vector3
from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.progress import Progress, no_progress, partial_progress
from compute.reconstruction.triangulation import reconstruct

Array = NDArray[np.float64]

MAX_LEAVE_ONE_OUT_POINTS: Final = 100
"""Largest number of control points that are left out one by one; more only block by block."""
BATCH_VALUES: Final = 2_000_000
"""Largest number of Jacobian elements in one batch of fits."""
MAX_BLOCKS: Final = 16
MIN_BLOCKS: Final = 5
POINTS_PER_BLOCK: Final = 3


def calibrate_and_assess(
    points_mm: Array,
    readings_px: Array,
    sensors: Sequence[SensorGeometry],
    sigma_px: Array | None = None,
    settings: CalibrationSettings = DEFAULTS,
    progress: Progress = no_progress,
) -> Calibration:
    """Calibrate, cross-validate and diagnose.

    The result is that of ``calibrate`` with ``cross_validation`` (by points where these are few,
    then by blocks of space) and ``diagnosis``.

    Args:
        points_mm: control points, shape (N, 3) [mm].
        readings_px: readings, shape (N, S) [px]; NaN where a sensor did not see the point.
        sensors: the device's S sensors.
        sigma_px: standard deviations of the readings, shape (N, S) [px], or None.
        settings: distortion, the control points' uncertainty, loss, labels.
        progress: called with the fraction done and the stage.

    Raises:
        LumilineError: those of ``calibrate``.
    """
    fitting = partial_progress(progress, 0.0, 0.5)
    calibration = calibrate(points_mm, readings_px, sensors, sigma_px, settings, progress=fitting)
    observations = points_mm, readings_px, sensors, sigma_px
    checks = []
    if len(points_mm) <= MAX_LEAVE_ONE_OUT_POINTS:
        by_points = partial_progress(progress, 0.5, 0.75)
        checks.append(cross_validate(calibration, *observations, "points", by_points))
    by_blocks = partial_progress(progress, 0.75, 0.9)
    checks.append(cross_validate(calibration, *observations, "blocks", by_blocks))
    used, _ = effective_readings(calibration, readings_px)
    pitch_um = [sensor.pitch_um for sensor in sensors]
    diagnosis = diagnose(
        calibration, points_mm, used, partial_progress(progress, 0.9, 1.0), pitch_um
    )
    return replace(calibration, cross_validation=tuple(checks), diagnosis=diagnosis)


def fitted_errors(
    calibration: Calibration, points_mm: Array, readings_px: Array, sigma_px: Array | None = None
) -> Array:
    """Reconstruct control points and subtract the given positions (the sign of Appendix F).

    Args:
        calibration: the calibration, with its covariance.
        points_mm: control points, shape (N, 3) [mm].
        readings_px: their readings, shape (N, S) [px]; NaN where not seen.
        sigma_px: their standard deviations, shape (N, S) [px]; None: the calibration's.

    Returns:
        Reconstructed minus given, shape (N, 3) [mm]; NaN where fewer than three sensors saw the
        point.
    """
    sigma = measurement_sigma(calibration, readings_px, sigma_px)
    covariance = np.array(calibration.covariance)
    points = reconstruct(calibration.models, readings_px, sigma, covariance, reliability=False)
    return points.position_mm - points_mm


def control_errors(
    calibration: Calibration, points_mm: Array, readings_px: Array, sigma_px: Array | None = None
) -> tuple[Array, int]:
    """Reconstruct the control points from the readings that the calibration's fit used.

    Args:
        calibration: the calibration of these points.
        points_mm: control points, shape (N, 3) [mm].
        readings_px: readings before label repair, shape (N, S) [px]; NaN where not seen.
        sigma_px: their standard deviations, shape (N, S) [px], or None.

    Returns:
        Reconstructed minus given, shape (N, 3) [mm], as from ``fitted_errors``, and the number of
        readings used.
    """
    used, sigma = effective_readings(calibration, readings_px, sigma_px)
    differences = fitted_errors(calibration, points_mm, used, sigma)
    return differences, count_readings(used, differences)


def cross_validate(
    calibration: Calibration,
    points_mm: Array,
    readings_px: Array,
    sensors: Sequence[SensorGeometry],
    sigma_px: Array | None = None,
    scheme: Literal["points", "blocks"] = "blocks",
    progress: Progress = no_progress,
) -> CrossValidation:
    """Predict each control point by sensors fitted without it, or without its block of space.

    All groups are fitted in batches, starting from the calibration. Its choices are kept: the
    distortion terms, the repaired labels, and the weights of a robust loss. Uncertain control
    points are weighted by their uncertainty, but not adjusted.

    Args:
        calibration: the calibration of all the points.
        points_mm: control points, shape (N, 3) [mm].
        readings_px: readings before label repair, shape (N, S) [px]; NaN where not seen.
        sensors: the S sensors.
        sigma_px: standard deviations of the readings, shape (N, S) [px], or None.
        scheme: "points": leave one out. "blocks": leave blocks out (``spatial_block_index``).
        progress: called with the fraction done and the stage.

    Raises:
        InvalidParameter: the calibration was not made from control points.
    """
    if calibration.method != "metric":
        raise InvalidParameter(
            f"the calibration's method is {calibration.method}; cross-validation needs one that "
            "was made from control points",
            method=calibration.method,
        )
    points = np.asarray(points_mm, dtype=np.float64)
    readings, sigma = repaired_readings(calibration, readings_px, sigma_px)
    count = len(points) if scheme == "points" else block_count(len(points))
    groups = np.arange(count) if scheme == "points" else spatial_block_index(points, count)
    observed = ControlObservations.of(points, readings, sensors, sigma)
    fits = _stored_fits(calibration, observed)
    settings = calibration.settings or DEFAULTS
    if sigma is not None and settings.position_sigma_mm is not None:
        observed = observed.with_point_sigma(fits.models, settings.position_sigma_mm)
    differences = np.full(points.shape, np.nan)
    predicted = np.full(readings.shape, np.nan)
    batch = max(1, BATCH_VALUES // (readings.size * CameraStack.of(fits.models).width))
    for first in range(0, count, batch):
        progress(first / count, f"cross-validation by {scheme}")
        training = groups != np.arange(first, min(first + batch, count))[:, None]
        for rest, refit in zip(training, _refits(observed, fits, settings, training), strict=True):
            if refit is None:
                continue
            rows = ~rest
            used = np.where(fits.weights[rows] > 0.0, readings[rows], np.nan)
            used_sigma = None if sigma is None else sigma[rows]
            differences[rows] = fitted_errors(refit, points[rows], used, used_sigma)
            stack = CameraStack.of(refit.models)
            predicted[rows] = stack.project(points[rows]) - stack.add_cubic_term(used)
    statistics = AxisErrors.of(differences)
    return CrossValidation(
        scheme,
        count,
        statistics if statistics.points else None,
        tuple(vector3(row) if np.isfinite(row).all() else None for row in differences),
        tuple(_rms(column) for column in predicted.T),
    )


def _rms(values: Array) -> float | None:
    finite = values[np.isfinite(values)]
    return float(np.sqrt((finite**2).mean())) if len(finite) else None


def _stored_fits(calibration: Calibration, observed: ControlObservations) -> SensorFits:
    """Return the fits of a calibration to its control points."""
    prior = LensPrior.of(
        calibration.models,
        observed.pitch_um,
        observed.points_mm,
        observed.observed_mask,
        prior_strength(calibration),
    )
    unit = None
    if not observed.sigma_known:
        unit = np.array([fit.sigma_px for fit in calibration.sensors])
    weights = np.ones(observed.readings_px.shape)
    if calibration.reading_weights is not None:
        weights = np.array(calibration.reading_weights, dtype=np.float64)
        weights = np.where(np.isnan(weights), 1.0, weights)
    return SensorFits(calibration.models, weights, prior, unit)


def _refits(
    observed: ControlObservations,
    fits: SensorFits,
    settings: CalibrationSettings,
    training: NDArray[np.bool_],
) -> Iterator[Calibration | None]:
    """Yield a calibration of each part (G, N) of the points; None where one is not possible."""
    sensors = len(fits.models)
    solution = fits.fit_without(observed, training)
    models = solution.cameras.models(fits.models * len(training))
    converged: NDArray[np.bool_] = np.all(solution.converged.reshape(-1, sensors), axis=1)
    for number, rest in enumerate(training):
        part = replace(
            observed,
            points_mm=observed.points_mm[rest],
            readings_px=observed.readings_px[rest],
            sigma_px=observed.sigma_px[rest],
        )
        part_models = models[number * sensors : (number + 1) * sensors]
        refit = SensorFits(part_models, fits.weights[rest], fits.prior, fits.unit_px)
        usable = bool(converged[number]) and _is_determined(part, refit)
        yield assemble_with_exact_points(part, refit, settings) if usable else None


def _is_determined(observed: ControlObservations, fits: SensorFits) -> bool:
    # Of the other parameters the prior says enough.
    if (fits.used(observed).sum(axis=0) < PARAMETER_COUNT).any():
        return False
    weights = fits.known_weights(observed)
    return not undetermined_sensors(fits.models, observed.points_mm, weights, fits.scaled_prior)


def block_count(points: int) -> int:
    """Return the number of blocks for a number of points: three points each, 5 to 16 blocks."""
    return int(min(points, max(MIN_BLOCKS, min(MAX_BLOCKS, points // POINTS_PER_BLOCK))))


def spatial_block_index(points_mm: Array, count: int) -> NDArray[np.intp]:
    """Assign points to blocks of space, by repeated halving across the longest extent.

    Model errors of neighbouring points are correlated. Points that are left out one by one would
    be predicted from neighbours with the same error; a block is not.

    Args:
        points_mm: shape (N, 3) [mm].
        count: number of blocks, at most N.

    Returns:
        The block of each point, 0 .. count - 1, shape (N,).
    """
    blocks = np.zeros(len(points_mm), dtype=np.intp)
    parts = [(np.arange(len(points_mm)), 0, count)]
    while parts:
        rows, first, share = parts.pop()
        if share == 1:
            blocks[rows] = first
            continue
        extent = np.ptp(points_mm[rows], axis=0)
        order = rows[np.argsort(points_mm[rows, int(extent.argmax())], kind="stable")]
        low = share // 2
        cut = round(len(rows) * low / share)
        parts += [(order[:cut], first, low), (order[cut:], first + low, share - low)]
    return blocks
