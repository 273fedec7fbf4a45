"""How well a calibration reproduces control points: fitted, and points that it never saw."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from compute.calibration.calibrate import calibrate
from compute.calibration.effective_readings import (
    count_readings,
    effective_readings,
    repaired_readings,
)
from compute.calibration.measurement_noise import measurement_sigma
from compute.calibration.result import AxisErrors, Calibration, CrossValidation
from compute.calibration.result_assembly import assemble_with_exact_points
from compute.calibration.settings import DEFAULTS, CalibrationSettings
from compute.calibration.single_sensor.design_matrix import check_determined
from compute.calibration.single_sensor.distortion_fit import LensOffsets, minimise_with_distortion
from compute.calibration.single_sensor.distortion_terms import free_parameters
from compute.calibration.single_sensor.sensor_fits import ControlObservations, SensorFits
from compute.calibration.spatial_blocks import block_count, spatial_block_index
from compute.camera.model import SensorGeometry, vector3
from compute.camera.stack import CameraStack
from compute.errors import DegeneratePoints, InvalidParameter, LumilineError
from compute.reconstruction.triangulation import reconstruct

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]

BATCH_VALUES: Final = 2_000_000
"""Elements of the Jacobians of the fits that are made at once."""


def fitted_errors(
    calibration: Calibration, points_mm: Array, readings_px: Array, sigma_px: Array | None = None
) -> Array:
    """Reconstruct the control points and return reconstructed minus given, shape (N, 3) [mm].

    As any readings are reconstructed, with the calibration's covariance. NaN for a point that
    fewer than three sensors saw. The sign is the thesis's (Appendix F).
    """
    sigma = measurement_sigma(calibration, readings_px, sigma_px)
    covariance = np.array(calibration.covariance)
    found = reconstruct(calibration.models, readings_px, sigma, covariance)
    return found.position_mm - points_mm


def control_errors(
    calibration: Calibration, points_mm: Array, readings_px: Array, sigma_px: Array | None = None
) -> tuple[Array, int]:
    """Reconstruct the control points from the readings that the calibration's fit used.

    Args:
        calibration: of these points.
        points_mm: control points, shape (N, 3) [mm].
        readings_px: readings as they were given, shape (N, S) [px]; NaN where not seen.
        sigma_px: their deviations, shape (N, S) [px], or None.

    Returns:
        Reconstructed minus given points, shape (N, 3) [mm], as of ``fitted_errors``, and how many
        readings they rest on.
    """
    used, sigma = effective_readings(calibration, readings_px, sigma_px)
    differences = fitted_errors(calibration, points_mm, used, sigma)
    return differences, count_readings(used, differences)


def leave_one_out(
    points_mm: Array,
    readings_px: Array,
    sensors: Sequence[SensorGeometry],
    sigma_px: Array | None = None,
    settings: CalibrationSettings = DEFAULTS,
    progress: Progress | None = None,
) -> Array:
    """Calibrate without each point in turn and return its errors, shape (N, 3) [mm].

    NaN where the rest does not calibrate every sensor, or fewer than three sensors saw the point.
    """
    calibration = calibrate(points_mm, readings_px, sensors, sigma_px, settings)
    found = cross_validate(
        calibration, points_mm, readings_px, sensors, sigma_px, "points", progress
    )
    return np.array(
        [(np.nan,) * 3 if row is None else row for row in found.differences_mm]
    ).reshape(-1, 3)


def cross_validate(
    calibration: Calibration,
    points_mm: Array,
    readings_px: Array,
    sensors: Sequence[SensorGeometry],
    sigma_px: Array | None = None,
    scheme: Literal["points", "blocks"] = "blocks",
    progress: Progress | None = None,
) -> CrossValidation:
    """Predict each control point by sensors fitted without it, or without its block of space.

    The sensors are fitted again, all groups at once, from the calibration, whose choices stay:
    its distortion terms, its labels, and the readings that a robust loss gave no weight. Each fit
    goes to its own minimum; one group less moves that, not by much. Points with an uncertainty of
    their own count by it, but are not adjusted.

    Args:
        calibration: of all the points.
        points_mm: control points, shape (N, 3) [mm].
        readings_px: readings, shape (N, S) [px], as given: labels are mended here again.
        sensors: as they were given.
        sigma_px: deviations of the readings, shape (N, S), or None.
        scheme: "points": leave each out. "blocks": blocks of space (``spatial_block_index``).
        progress: called with the fraction done and the stage; what it raises passes through.

    Raises:
        InvalidParameter: the calibration was not made of control points.
    """
    points = np.asarray(points_mm, dtype=np.float64)
    readings, sigma = repaired_readings(calibration, readings_px, sigma_px)
    count = len(points) if scheme == "points" else block_count(len(points))
    groups = np.arange(count) if scheme == "points" else spatial_block_index(points, count)
    work, published = None, DEFAULTS
    if calibration.method == "metric":
        work = _MetricGroups.of(calibration, points, readings, sensors, sigma)
    elif calibration.method == "dlt-iterative" or calibration.method == "bundle-11":
        published = CalibrationSettings(calibration.method)
    else:
        raise InvalidParameter(
            f"the calibration's method is {calibration.method}; only one that was made of control "
            "points is cross-validated by them",
            method=calibration.method,
        )
    differences = np.full(points.shape, np.nan)
    predicted = np.full(readings.shape, np.nan)
    batch = count if work is None else work.batch()
    for first in range(0, count, batch):
        numbers = range(first, min(first + batch, count))
        if progress is not None:
            progress(first / count, f"cross-validation by {scheme}")
        if work is not None:
            found = work.fitted([groups != number for number in numbers])
        else:
            found = [
                _refit(points, readings, sensors, sigma, groups != number, published)
                for number in numbers
            ]
        for number, one in zip(numbers, found, strict=True):
            if one is None:
                continue
            rows = groups == number
            own = None if sigma is None else sigma[rows]
            used = readings[rows]
            if work is not None:
                used = np.where(work.fits.weights[rows] > 0.0, used, np.nan)
            differences[rows] = fitted_errors(one, points[rows], used, own)
            stack = CameraStack.of(one.models)
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
    here = values[np.isfinite(values)]
    return float(np.sqrt((here**2).mean())) if len(here) else None


def _refit(
    points: Array,
    readings: Array,
    sensors: Sequence[SensorGeometry],
    sigma: Array | None,
    rest: NDArray[np.bool_],
    settings: CalibrationSettings,
) -> Calibration | None:
    """Calibrate by a published method without a group; None where that is not possible."""
    try:
        return calibrate(
            points[rest],
            readings[rest],
            sensors,
            None if sigma is None else sigma[rest],
            settings,
        )
    except LumilineError:
        return None


@dataclass(frozen=True, eq=False)
class _MetricGroups:
    """A metric calibration, ready to be fitted without groups of its points."""

    observed: ControlObservations
    fits: SensorFits
    settings: CalibrationSettings

    @classmethod
    def of(
        cls,
        calibration: Calibration,
        points: Array,
        readings: Array,
        sensors: Sequence[SensorGeometry],
        sigma: Array | None,
    ) -> "_MetricGroups":
        settings = calibration.settings or DEFAULTS
        seen = np.isfinite(readings)
        stack = CameraStack.of(calibration.models)
        given = np.ones(readings.shape) if sigma is None else np.where(seen, sigma, 1.0)
        if sigma is not None and settings.control_sigma_mm is not None:
            jacobian = np.nan_to_num(stack.linearise(points)[1])
            given = np.hypot(given, settings.control_sigma_mm * np.linalg.norm(jacobian, axis=2))
        observed = ControlObservations(points, readings, given, sigma is not None, tuple(sensors))
        lens_offsets = LensOffsets.of(calibration.models, observed.pitch_um, points, seen)
        if sigma is None:
            lens_offsets = lens_offsets.scaled(
                np.array([fit.sigma_px for fit in calibration.sensors])
            )
        weights = np.ones(readings.shape)
        if calibration.reading_weights is not None:
            weights = np.array(calibration.reading_weights, dtype=np.float64)
            weights = np.where(np.isnan(weights), 1.0, weights)
        return cls(observed, SensorFits(calibration.models, weights, lens_offsets), settings)

    def batch(self) -> int:
        """Return how many groups are fitted at once."""
        stack = CameraStack.of(self.fits.models)
        return max(1, BATCH_VALUES // (self.observed.readings_px.size * stack.width))

    def fitted(self, rests: list[NDArray[np.bool_]]) -> list[Calibration | None]:
        """Return a calibration of each rest of the points; None where one is not possible."""
        observed, fits = self.observed, self.fits
        sensors = len(fits.models)
        index = np.tile(np.arange(sensors), len(rests))
        left = np.repeat(np.array(rests), sensors, axis=0).T
        weights = (observed.weights * np.sqrt(fits.weights))[:, index] * left
        ended = minimise_with_distortion(
            CameraStack.of(fits.models).rows(index),
            observed.points_mm,
            observed.readings_px[:, index],
            weights,
            fits.lens_offsets.prior.rows(index),
            multi_start=False,
        )
        models = ended.cameras.models([fits.models[one] for one in index])
        converged: NDArray[np.bool_] = np.all(ended.converged.reshape(-1, sensors), axis=1)
        found: list[Calibration | None] = []
        for number, rest in enumerate(rests):
            own = models[number * sensors : (number + 1) * sensors]
            part = replace(
                observed,
                points_mm=observed.points_mm[rest],
                readings_px=observed.readings_px[rest],
                sigma_px=observed.sigma_px[rest],
            )
            here = SensorFits(own, fits.weights[rest], fits.lens_offsets)
            usable = bool(converged[number]) and _is_determined(part, here)
            found.append(assemble_with_exact_points(part, here, self.settings) if usable else None)
        return found


def _is_determined(observed: ControlObservations, fits: SensorFits) -> bool:
    for column, model in enumerate(fits.models):
        rows = observed.seen[:, column] & (fits.weights[:, column] > 0.0)
        terms = () if model.distortion is None else model.distortion.terms
        if rows.sum() < free_parameters(terms):
            return False
    used = np.where(fits.weights > 0.0, observed.weights, 0.0)
    try:
        check_determined(fits.models, observed.points_mm, used, fits.lens_offsets.prior.sigma_mm)
    except DegeneratePoints:
        return False
    return True
