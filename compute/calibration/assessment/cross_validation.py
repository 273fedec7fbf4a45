"""Cross-validation: control points reconstructed by calibrations fitted without them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from compute.calibration.result import (
    AxisErrors,
    Calibration,
    CrossValidation,
    count_readings,
    effective_readings,
    measurement_sigma,
    repaired_readings,
)
from compute.calibration.result_assembly import assemble_with_exact_points
from compute.calibration.settings import DEFAULTS, CalibrationSettings
from compute.calibration.single_sensor.camera_fit import LensOffsets, minimise_with_distortion
from compute.calibration.single_sensor.design_matrix import check_determined, fitted_columns
from compute.calibration.single_sensor.sensor_fits import ControlObservations, SensorFits
from compute.camera.model import SensorGeometry, vector3
from compute.camera.stack import CameraStack
from compute.errors import DegeneratePoints, InvalidParameter
from compute.progress import Progress
from compute.reconstruction.triangulation import reconstruct

Array = NDArray[np.float64]

MAX_BLOCKS: Final = 16
MIN_BLOCKS: Final = 5
POINTS_PER_BLOCK: Final = 3
BATCH_VALUES: Final = 2_000_000
"""Largest number of Jacobian elements in one batch of fits."""


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
        parts.append((order[:cut], first, low))
        parts.append((order[cut:], first + low, share - low))
    return blocks


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
    found = reconstruct(calibration.models, readings_px, sigma, covariance)
    return found.position_mm - points_mm


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
    progress: Progress | None = None,
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
    points = np.asarray(points_mm, dtype=np.float64)
    readings, sigma = repaired_readings(calibration, readings_px, sigma_px)
    count = len(points) if scheme == "points" else block_count(len(points))
    groups = np.arange(count) if scheme == "points" else spatial_block_index(points, count)
    if calibration.method != "metric":
        raise InvalidParameter(
            f"the calibration's method is {calibration.method}; cross-validation needs one that "
            "was made from control points",
            method=calibration.method,
        )
    refits = _Refits.of(calibration, points, readings, sensors, sigma)
    differences = np.full(points.shape, np.nan)
    predicted = np.full(readings.shape, np.nan)
    batch = refits.batch()
    for first in range(0, count, batch):
        numbers = range(first, min(first + batch, count))
        if progress is not None:
            progress(first / count, f"cross-validation by {scheme}")
        refitted = refits.fit_without([groups == number for number in numbers])
        for number, refit in zip(numbers, refitted, strict=True):
            if refit is None:
                continue
            rows = groups == number
            used = np.where(refits.fits.weights[rows] > 0.0, readings[rows], np.nan)
            differences[rows] = fitted_errors(
                refit, points[rows], used, None if sigma is None else sigma[rows]
            )
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


@dataclass(frozen=True, eq=False)
class _Refits:
    """Fits of a calibration's sensors without groups of its control points."""

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
    ) -> "_Refits":
        settings = calibration.settings or DEFAULTS
        seen = np.isfinite(readings)
        stack = CameraStack.of(calibration.models)
        reading_sigma = np.ones(readings.shape) if sigma is None else np.where(seen, sigma, 1.0)
        if sigma is not None and settings.control_sigma_mm is not None:
            jacobian = np.nan_to_num(stack.linearise(points)[1])
            point_sigma = settings.control_sigma_mm * np.linalg.norm(jacobian, axis=2)
            reading_sigma = np.hypot(reading_sigma, point_sigma)
        observed = ControlObservations(
            points, readings, reading_sigma, sigma is not None, tuple(sensors)
        )
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
        """Return the number of groups in one batch."""
        stack = CameraStack.of(self.fits.models)
        return max(1, BATCH_VALUES // (self.observed.readings_px.size * stack.width))

    def fit_without(self, left_out: list[NDArray[np.bool_]]) -> list[Calibration | None]:
        """Return a calibration without each group of points; None where one is not possible.

        Args:
            left_out: for each group, which of the N points it holds, shape (N,).
        """
        rests = [~group for group in left_out]
        observed, fits = self.observed, self.fits
        sensors = len(fits.models)
        index = np.tile(np.arange(sensors), len(rests))
        kept = np.repeat(np.array(rests), sensors, axis=0).T
        weights = (observed.weights * np.sqrt(fits.weights))[:, index] * kept
        ended = minimise_with_distortion(
            CameraStack.of(fits.models).rows(index),
            observed.points_mm,
            observed.readings_px[:, index],
            weights,
            fits.lens_offsets.prior.rows(index),
            multi_start=False,
        )
        models = ended.cameras.models([fits.models[sensor] for sensor in index])
        converged: NDArray[np.bool_] = np.all(ended.converged.reshape(-1, sensors), axis=1)
        found: list[Calibration | None] = []
        for number, rest in enumerate(rests):
            group_models = models[number * sensors : (number + 1) * sensors]
            part = replace(
                observed,
                points_mm=observed.points_mm[rest],
                readings_px=observed.readings_px[rest],
                sigma_px=observed.sigma_px[rest],
            )
            refit = SensorFits(group_models, fits.weights[rest], fits.lens_offsets)
            usable = bool(converged[number]) and _is_determined(part, refit)
            found.append(assemble_with_exact_points(part, refit, self.settings) if usable else None)
        return found


def _is_determined(observed: ControlObservations, fits: SensorFits) -> bool:
    for column, model in enumerate(fits.models):
        rows = observed.seen[:, column] & (fits.weights[:, column] > 0.0)
        if rows.sum() < len(fitted_columns(model)):
            return False
    used = np.where(fits.weights > 0.0, observed.weights, 0.0)
    try:
        check_determined(fits.models, observed.points_mm, used, fits.lens_offsets.prior.sigma_mm)
    except DegeneratePoints:
        return False
    return True
