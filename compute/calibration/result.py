"""What a calibration run yields: the sensor models, their joint covariance, the residuals."""

from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray

from compute.calibration.assessment_result import Diagnosis, DistortionSelection
from compute.calibration.mislabels.finding import LabelFinding
from compute.calibration.mislabels.repair import exclude, repair
from compute.calibration.settings import CalibrationSettings
from compute.camera.model import SensorGeometry, SensorModel, Vector3, vector3

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
        points: control points that this sensor saw.
        rms_px: root mean square of the residuals [px].
        max_px: largest absolute residual [px].
        sigma_px: standard deviation of one reading [px] that the covariance rests on.
        sigma_source: where it comes from: given with the readings (their root mean square),
            estimated from the residuals, or, with fewer than ten points, assumed (a pixel's
            quantisation, or the residuals where they are larger).
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
    """Points and readings predicted by calibrations that never saw them.

    Args:
        scheme: "points": left out one by one. "blocks": in blocks of space.
        groups: how many were left out in turn.
        errors: of the points; None where none could be had.
        differences_mm: reconstructed minus given, point by point; None where not to be had.
        reading_rms_px: RMS of predicted minus measured readings for each sensor [px]; None where
            not to be had.
    """

    scheme: Literal["points", "blocks"]
    groups: int
    errors: AxisErrors | None
    differences_mm: tuple[Vector3 | None, ...]
    reading_rms_px: tuple[float | None, ...]


@dataclass(frozen=True)
class Calibration:
    """The camera models of one device, with what is known of their errors.

    Args:
        method: how it was made.
        sensors: one fit for each sensor, in the device's order.
        covariance: joint covariance of all parameters, shape (P, P), sensor by sensor in the
            order of ``SensorModel.parameter_names``; 0 for what was not fitted.
        residuals_px: fitted minus measured reading [px], shape (N, S); None where not seen.
        settings: what the run was asked to do; None in documents older than settings.
        distortion: how its terms were chosen; None where none were asked for.
        reading_weights: weights between 0 and 1 that a robust loss left to the readings, shape
            (N, S), None where not seen; None with a linear loss.
        point_shifts_mm: fitted minus given control points, shape (N, 3) [mm]; None where they
            were taken as exact.
        labels: wrong and exchanged labels that were found.
        cross_validation: by points and by blocks, as far as they were made.
        diagnosis: None where it was not made.
    """

    method: Method
    sensors: tuple[SensorFit, ...]
    covariance: tuple[tuple[float, ...], ...]
    residuals_px: tuple[tuple[float | None, ...], ...]
    settings: CalibrationSettings | None = None
    distortion: DistortionSelection | None = None
    reading_weights: tuple[tuple[float | None, ...], ...] | None = None
    point_shifts_mm: tuple[Vector3, ...] | None = None
    labels: tuple[LabelFinding, ...] = ()
    cross_validation: tuple[CrossValidation, ...] = ()
    diagnosis: Diagnosis | None = None

    @property
    def models(self) -> tuple[SensorModel, ...]:
        """The camera models in the device's order."""
        return tuple(fit.model for fit in self.sensors)


Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MeasurementNoise:
    """What a calibration says of each sensor's readings; made once where frames come by the second.

    Args:
        sensor_sigma_px: standard deviation of a reading that came without one, shape (S,).
        model_error_px: what the residuals exceed the noise by, in squares, shape (S,).
        min_sigma_px: the least deviation that is taken, shape (S,).
    """

    sensor_sigma_px: Array
    model_error_px: Array
    min_sigma_px: Array

    @classmethod
    def of(cls, calibration: Calibration) -> Self:
        """Return that of a calibration of S sensors."""
        fits = calibration.sensors
        own = np.array([fit.sigma_px for fit in fits])
        excess = np.array([max((fit.chi2_per_dof or 1.0) - 1.0, 0.0) for fit in fits])
        least = [fit.sigma_px if fit.sigma_source == "residuals" else 0.0 for fit in fits]
        return cls(own, own * np.sqrt(excess), np.array(least))

    def sigma(self, sigma_px: Array) -> Array:
        """Return the deviations with which readings go into a reconstruction, shape (..., S) [px].

        Args:
            sigma_px: their own, shape (..., S); where NaN, the calibration's are taken.
        """
        given = np.where(np.isnan(sigma_px), self.sensor_sigma_px, sigma_px)
        trusted: Array = np.maximum(np.hypot(given, self.model_error_px), self.min_sigma_px)
        return trusted


def measurement_sigma(
    calibration: Calibration, readings_px: Array, sigma_px: Array | None = None
) -> Array:
    """Return the standard deviations with which readings (..., S) go into a reconstruction [px].

    A reading is not known better than the model reproduces its control points. Where these came
    with their deviations, what the residuals exceed them by is misfit and is added in squares;
    where they came without, the residuals hold both, and are the least that is taken. Where the
    deviation was assumed, there is nothing to compare with.

    Args:
        calibration: the calibration in use.
        readings_px: shape (..., S); only the shape is used.
        sigma_px: the readings' own deviations, shape (..., S); where NaN, and for None, the
            calibration's are taken.
    """
    trust = MeasurementNoise.of(calibration)
    given = trust.sensor_sigma_px if sigma_px is None else sigma_px
    return trust.sigma(np.broadcast_to(given, readings_px.shape))


def repaired_readings(
    calibration: Calibration, readings_px: Array, sigma_px: Array | None = None
) -> tuple[Array, Array | None]:
    """Return readings and deviations (N, S) with the label findings dealt with as the run did.

    Args:
        calibration: of control points; readings of another number of points stay as they are.
        readings_px: their readings as they were given, shape (N, S) [px]; NaN where not seen.
        sigma_px: their deviations, shape (N, S) [px], or None.
    """
    readings = np.asarray(readings_px, dtype=np.float64)
    sigma = None if sigma_px is None else np.asarray(sigma_px, dtype=np.float64)
    policy = "off" if calibration.settings is None else calibration.settings.labels
    own = len(calibration.residuals_px) == len(readings)
    if policy in ("off", "report") or not calibration.labels or not own:
        return readings, sigma
    sensors = [SensorGeometry(model.name, model.pixels) for model in calibration.models]
    return (exclude if policy == "exclude" else repair)(
        calibration.labels, sensors, readings, sigma
    )


def effective_readings(
    calibration: Calibration, readings_px: Array, sigma_px: Array | None = None
) -> tuple[Array, Array | None]:
    """Return readings and deviations (N, S) as the calibration's fit used them; NaN where not.

    Label findings are dealt with as the run did, and what a robust loss gave no weight is left
    out. Arguments are those of ``repaired_readings``.
    """
    readings, sigma = repaired_readings(calibration, readings_px, sigma_px)
    given = calibration.reading_weights
    if given is not None and len(given) == len(readings):
        weights = np.array(given, dtype=np.float64).reshape(readings.shape)
        readings = np.where(weights == 0.0, np.nan, readings)
    return readings, sigma


def count_readings(effective_px: Array, differences_mm: Array) -> int:
    """Return how many readings the reconstructed points rest on.

    Args:
        effective_px: readings that were used, shape (N, S) [px]; NaN where not.
        differences_mm: reconstructed minus given points, shape (N, 3); NaN where there is none.
    """
    return int(np.isfinite(effective_px[np.isfinite(differences_mm).all(axis=1)]).sum())
