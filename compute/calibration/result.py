"""What a calibration run yields: the sensor models, their joint covariance, the residuals."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from compute.calibration.assessment_result import Diagnosis, DistortionSelection
from compute.calibration.mislabels.finding import LabelFinding
from compute.calibration.settings import CalibrationSettings, Method
from compute.camera.model import SensorModel, Vector3, vector3

MethodWithoutControl = Literal["self-calibration", "update"]
"""Methods that know no coordinates: a subject at unknown places; and a calibration that was
brought up to date by a still set of markers."""


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
        iteration_change_px: largest change of a corrected reading in the last iteration of the
            iterative DLT [px], which runs a fixed number of them; None for other methods.
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
    iteration_change_px: float | None = None


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

    method: Method | MethodWithoutControl
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
