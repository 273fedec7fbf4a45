"""Calibration: sensor models, joint covariance, residuals; the readings' noise that follows."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from compute.calibration.assessment_result import Diagnosis, DistortionEstimate
from compute.calibration.mislabels.repair import CORRECTIONS, LabelFinding
from compute.calibration.settings import WEAK_STRENGTH, CalibrationSettings
from compute.camera.model import SensorModel, Vector3, vector3
from compute.measurement.measurements import MeasurementNoise

Array = NDArray[np.float64]
Method = Literal["metric", "self-calibration", "update", "dlt-iterative", "bundle-11"]
"""How a calibration was made.

- metric: from control points of known coordinates.
- self-calibration: from targets at unknown poses.
- update: an earlier calibration, updated by stationary markers.
- dlt-iterative, bundle-11: the thesis's methods; in stored calibrations of earlier versions only.
"""


@dataclass(frozen=True)
class SensorFit:
    """One sensor's fitted model and how well it fits.

    Args:
        model: the fitted camera.
        points: number of control points that this sensor saw.
        rms_px: root mean square of the residuals [px].
        max_px: largest absolute residual [px].
        sigma_px: standard deviation of one reading [px] that the covariance rests on.
        sigma_source: "given": with the readings (their root mean square). "residuals": estimated.
            "assumed": with fewer than ten points, quantisation to a pixel, or the residuals' RMS
            where that is larger; with uncertain control points, a share of what these do to the
            readings, where the joint adjustment did not converge with less.
        chi2_per_dof: weighted sum of squares per degree of freedom, about 1 when the given
            standard deviations are right; None without redundancy or without given ones.
    """

    model: SensorModel
    points: int
    rms_px: float
    max_px: float
    sigma_px: float
    sigma_source: Literal["given", "residuals", "assumed"]
    chi2_per_dof: float | None


@dataclass(frozen=True)
class AxisErrors:
    """Statistics of differences X, Y, Z, reconstructed minus given points [mm]."""

    points: int
    mean_absolute_mm: Vector3
    max_absolute_mm: Vector3
    mean_mm: Vector3
    standard_deviation_mm: Vector3

    @classmethod
    def of(cls, differences_mm: NDArray[np.float64]) -> "AxisErrors":
        """Summarise differences of shape (N, 3) [mm]; rows with NaN are left out."""
        rows = differences_mm[np.isfinite(differences_mm).all(axis=1)]
        if len(rows) == 0:
            nan = (float("nan"),) * 3
            return cls(0, nan, nan, nan, nan)
        absolute = np.abs(rows)
        sigma = rows.std(axis=0, ddof=1) if len(rows) > 1 else np.zeros(3)
        return cls(
            len(rows),
            vector3(absolute.mean(axis=0)),
            vector3(absolute.max(axis=0)),
            vector3(rows.mean(axis=0)),
            vector3(sigma),
        )


@dataclass(frozen=True)
class CrossValidation:
    """Control points and readings predicted by calibrations fitted without them.

    Args:
        scheme: "points": left out one by one. "blocks": by blocks of space.
        groups: number of points or blocks that were left out in turn.
        errors: statistics of the points' errors; None: no point was reconstructed.
        differences_mm: reconstructed minus given, for each point; None: not reconstructed.
        reading_rms_px: RMS of predicted minus measured readings of each sensor [px]; None: no
            reading was predicted.
    """

    scheme: Literal["points", "blocks"]
    groups: int
    errors: AxisErrors | None
    differences_mm: tuple[Vector3 | None, ...]
    reading_rms_px: tuple[float | None, ...]


@dataclass(frozen=True)
class Calibration:
    """The camera models of one device with their uncertainty.

    Args:
        method: how it was made.
        sensors: one fit for each sensor, in the device's order.
        covariance: joint covariance of all parameters, shape (P, P), sensor by sensor in the
            order of ``SensorModel.parameter_names``; 0 for what was not fitted.
        residuals_px: fitted minus measured reading [px], shape (N, S); None where not seen.
        settings: the run's settings; None in documents older than settings.
        distortion: how its terms were chosen; None: no distortion was requested.
        reading_weights: weights of the readings by a robust loss, 0 to 1, shape (N, S), None where
            not seen; None with a linear loss.
        point_shifts_mm: adjusted minus given control points, shape (N, 3) [mm]; None: the points
            were exact.
        labels: wrong and exchanged labels that were found.
        cross_validation: by points, by blocks, both or neither.
        diagnosis: None: not made.
    """

    method: Method
    sensors: tuple[SensorFit, ...]
    covariance: tuple[tuple[float, ...], ...]
    residuals_px: tuple[tuple[float | None, ...], ...]
    settings: CalibrationSettings | None = None
    distortion: DistortionEstimate | None = None
    reading_weights: tuple[tuple[float | None, ...], ...] | None = None
    point_shifts_mm: tuple[Vector3, ...] | None = None
    labels: tuple[LabelFinding, ...] = ()
    cross_validation: tuple[CrossValidation, ...] = ()
    diagnosis: Diagnosis | None = None

    @property
    def models(self) -> tuple[SensorModel, ...]:
        """The camera models in the device's order."""
        return tuple(fit.model for fit in self.sensors)


def prior_strength(calibration: Calibration) -> float:
    """Return the strength of the lenses' prior that a calibration was fitted with."""
    distortion = calibration.distortion
    if distortion is None or distortion.scale is None:
        return WEAK_STRENGTH
    return distortion.scale


def measurement_noise(calibration: Calibration) -> MeasurementNoise:
    """Return the readings' noise by a calibration's fit statistics."""
    fits = calibration.sensors
    sensor_sigma = np.array([fit.sigma_px for fit in fits])
    excess = np.array([max((fit.chi2_per_dof or 1.0) - 1.0, 0.0) for fit in fits])
    minimum = [fit.sigma_px if fit.sigma_source == "residuals" else 0.0 for fit in fits]
    return MeasurementNoise(sensor_sigma, sensor_sigma * np.sqrt(excess), np.array(minimum))


def nested_rows(matrix: Array) -> tuple[tuple[float | None, ...], ...]:
    """Return a matrix as nested tuples, None for NaN."""
    return tuple(tuple(None if x != x else x for x in row) for row in matrix.tolist())


def measurement_sigma(
    calibration: Calibration, readings_px: Array, sigma_px: Array | None = None
) -> Array:
    """Return the standard deviations of readings for reconstruction, shape (..., S) [px].

    Model error adds to a reading's noise. If the control readings had known standard deviations,
    their residuals' excess variance is the model error and is added. If not, the residuals contain
    noise and model error, and are the lower bound. With an assumed standard deviation, neither is
    known and nothing is added.

    Args:
        calibration: the active calibration.
        readings_px: shape (..., S); only the shape is used.
        sigma_px: the readings' own standard deviations, shape (..., S) [px]; NaN or None: the
            calibration's are used.
    """
    noise = measurement_noise(calibration)
    reading_sigma = noise.sensor_sigma_px if sigma_px is None else sigma_px
    return noise.sigma(np.broadcast_to(reading_sigma, readings_px.shape))


def repaired_readings(
    calibration: Calibration, readings_px: Array, sigma_px: Array | None = None
) -> tuple[Array, Array | None]:
    """Repair or exclude wrong labels as the calibration's run did.

    Args:
        calibration: the calibration; readings of another number of points are returned unchanged.
        readings_px: readings of its control points as posted, shape (N, S) [px]; NaN where not
            seen.
        sigma_px: their standard deviations, shape (N, S) [px], or None.

    Returns:
        Readings and standard deviations, shape (N, S) [px].
    """
    readings = np.asarray(readings_px, dtype=np.float64)
    sigma = None if sigma_px is None else np.asarray(sigma_px, dtype=np.float64)
    correct = CORRECTIONS.get(calibration.settings.labels) if calibration.settings else None
    same_points = len(calibration.residuals_px) == len(readings)
    if correct is None or not calibration.labels or not same_points:
        return readings, sigma
    return correct(calibration.labels, calibration.models, readings, sigma)


def effective_readings(
    calibration: Calibration, readings_px: Array, sigma_px: Array | None = None
) -> tuple[Array, Array | None]:
    """Return the readings that the calibration's fit used.

    Wrong labels are repaired or excluded as in the run; readings to which a robust loss gave no
    weight are excluded.

    Args:
        calibration: the calibration; readings of another number of points are returned unchanged.
        readings_px: readings of its control points as posted, shape (N, S) [px]; NaN where not
            seen.
        sigma_px: their standard deviations, shape (N, S) [px], or None.

    Returns:
        Readings, NaN where not used, and standard deviations, shape (N, S) [px].
    """
    readings, sigma = repaired_readings(calibration, readings_px, sigma_px)
    stored = calibration.reading_weights
    if stored is not None and len(stored) == len(readings):
        weights = np.array(stored, dtype=np.float64).reshape(readings.shape)
        readings = np.where(weights == 0.0, np.nan, readings)
    return readings, sigma


def count_readings(effective_px: Array, differences_mm: Array) -> int:
    """Count the readings of points that were reconstructed.

    Args:
        effective_px: readings that the fit used, shape (N, S) [px]; NaN where not.
        differences_mm: reconstructed minus given points, shape (N, 3) [mm]; NaN where there is
            none.
    """
    return int(np.isfinite(effective_px[np.isfinite(differences_mm).all(axis=1)]).sum())
