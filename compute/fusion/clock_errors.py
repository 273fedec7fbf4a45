"""Errors of the bars' clocks in points: how they move them, and what the readings tell of them.

All readings of a bar that is timed wrongly are off along their rates by the same time. That is
one error a bar, not one a reading: it is a term of rank one of the readings' covariance. A clock
error ``d`` means that the bar states its exposures later by ``d`` than they were; its readings at a
stated time are those of ``d`` before, off by ``-rate d``.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements
from compute.reconstruction.point_batch import PointBatch, PointFlag
from compute.reconstruction.triangulation import chi2_limits, reading_variance

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PeakRates:
    """How fast the K readings of each of S sensors change.

    Args:
        rate_px_s: shape (S, K) [px/s]; 0 where it is not known.
        rate_variance_px2_s2: its variance by noise, shape (S, K) [px^2/s^2].
        covariance_px2_s: its covariance with the position, shape (S, K) [px^2/s].
    """

    rate_px_s: Array
    rate_variance_px2_s2: Array
    covariance_px2_s: Array


@dataclass(frozen=True, eq=False)
class PointReadings:
    """The readings that N points come from; NaN where a sensor has none.

    Args:
        position_px: shape (N, S) [px].
        sigma_px: their standard deviations, shape (N, S) [px].
        rate_px_s: how fast they change, shape (N, S) [px/s].
        rate_variance_px2_s2: variance of that by noise, shape (N, S) [px^2/s^2].
        covariance_px2_s: its covariance with the position, shape (N, S) [px^2/s].
    """

    position_px: Array
    sigma_px: Array
    rate_px_s: Array
    rate_variance_px2_s2: Array
    covariance_px2_s: Array

    @classmethod
    def nearest(
        cls,
        model: MeasurementModel,
        points: PointBatch,
        measurements: Measurements,
        rates: PeakRates,
    ) -> "PointReadings":
        """Return the readings of one exposure that lie nearest to those predicted for its points.

        Args:
            model: the cameras.
            points: N points of the exposure.
            measurements: of the exposure, shape (S, K).
            rates: of these.
        """
        predicted = model.linearise(points.position_mm)[0]
        apart = np.abs(measurements.position_px - predicted[..., None])
        apart[np.isnan(apart)] = np.inf
        peak = apart.argmin(axis=2)
        sensor = np.arange(len(measurements))
        used = points.used & np.isfinite(apart.min(axis=2))
        values = (measurements.position_px, measurements.sigma_px, *vars(rates).values())
        return cls(*(np.where(used, value[sensor, peak], np.nan) for value in values))


@dataclass(frozen=True, eq=False)
class ClockSensitivity:
    """How the errors of B clocks act on N points, and what the points' readings tell of them.

    Args:
        shift_mm_s: d position / d clock error, shape (N, 3, B) [mm/s].
        information: of the clock errors in the residuals of each point, as if the rates were
            known, shape (N, B, B) [1/s^2]; the covariance of ``score``.
        by_noise: what of its diagonal comes on the mean from the noise of the rates and tells
            nothing, shape (N, B) [1/s^2].
        score: gradient of the log likelihood by the clock errors where they are zero, less its
            mean by the noise that rates and readings share, shape (N, B) [1/s].
        common: d score / d common errors of the calibration, shape (N, B, E) [1/s]; E is 0 where it
            was not asked for.
    """

    shift_mm_s: Array
    information: Array
    by_noise: Array
    score: Array
    common: Array


def clock_sensitivity(
    model: MeasurementModel,
    points: PointBatch,
    readings: PointReadings,
    bar_of_sensor: NDArray[np.intp],
    *,
    with_common_errors: bool = False,
) -> ClockSensitivity:
    """Return how clock errors act on points; points without a position have zeros.

    Args:
        model: the cameras, their covariance and correction table.
        points: N points.
        readings: that they come from.
        bar_of_sensor: number of each sensor's bar, shape (S,); -1: of the bar whose clock is the
            reference.
        with_common_errors: whether to work out ``common``.
    """
    located = np.isfinite(points.position_mm[:, 0])
    position = np.where(located[:, None], points.position_mm, 0.0)
    used = points.used & located[:, None] & np.isfinite(readings.position_px)
    reading = np.where(used, readings.position_px, np.nan)
    sigma = np.where(used, readings.sigma_px, 1.0)
    residual, jacobian = model.residuals(reading, position)
    derivative = model.cameras.correction_derivative(reading)
    variance = reading_variance(model, reading, sigma, used, position)
    whitening = model.whitening(position, variance, used)
    rate = np.where(used, readings.rate_px_s * derivative, 0.0)
    residual = np.where(used, residual, 0.0)
    jacobian = np.where(used[..., None], jacobian, 0.0)
    bars = np.arange(int(bar_of_sensor.max(initial=-1)) + 1)
    member = bar_of_sensor[:, None] == bars
    whitened_jacobian = whitening @ jacobian
    covariance = np.where(located[:, None, None], points.covariance_mm2, 0.0)
    gain = covariance @ whitened_jacobian.swapaxes(1, 2) @ whitening
    # The points have taken up what of an error fits them; the rest shows in the residuals.
    visible = whitening.swapaxes(1, 2) @ (whitening - whitened_jacobian @ gain)
    by_clock = -rate[..., None] * member
    shown = by_clock.swapaxes(1, 2) @ visible
    information = shown @ by_clock
    score = (shown @ residual[..., None])[..., 0]
    # Rates come from the same noisy readings as positions do.
    weight = np.diagonal(visible, axis1=1, axis2=2) * np.where(used, derivative, 0.0) ** 2
    score += np.where(used, weight * readings.covariance_px2_s, 0.0) @ member
    by_noise = np.where(used, weight * readings.rate_variance_px2_s2, 0.0) @ member
    common = np.zeros((*score.shape, 0))
    if with_common_errors and model.parameter_covariance is not None:
        by_error = model.common_jacobian(position) * derivative[..., None]
        common = shown @ np.where(used[..., None], by_error, 0.0)
    return ClockSensitivity(gain @ by_clock, information, by_noise, score, common)


def correct_points(
    points: PointBatch, sensitivity: ClockSensitivity, error_s: Array, covariance_s2: Array
) -> PointBatch:
    """Return points free of known clock errors, with the covariance of what is not known of them.

    Args:
        points: N points.
        sensitivity: of these points.
        error_s: the clock errors, shape (B,) [s].
        covariance_s2: their covariance, shape (B, B) [s^2].
    """
    shift, information = sensitivity.shift_mm_s, sensitivity.information
    position = points.position_mm - shift @ error_s
    covariance = points.covariance_mm2 + shift @ covariance_s2 @ shift.swapaxes(1, 2)
    score = sensitivity.score - information @ error_s
    # r' P (r - U d), and Woodbury's identity for the part that the clocks' covariance explains.
    chi2 = points.chi2 - (sensitivity.score + score) @ error_s
    bars = len(error_s)
    explained = np.linalg.solve(np.eye(bars) + covariance_s2 @ information, covariance_s2)
    chi2 = np.maximum(chi2 - np.einsum("nb,nbc,nc->n", score, explained, score), 0.0)
    flags = points.flags
    inconsistent = (flags & int(PointFlag.INCONSISTENT)) != 0
    if inconsistent.any():
        limits = chi2_limits(points.used.shape[1])[points.used.sum(axis=1)]
        cleared = inconsistent & (chi2 <= limits)
        flags = np.where(cleared, flags & ~int(PointFlag.INCONSISTENT), flags).astype(np.int32)
    return replace(points, position_mm=position, covariance_mm2=covariance, chi2=chi2, flags=flags)
