"""ReportContent: everything a report shows, of a stored calibration or one from a file."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from compute.calibration.assessment.assess import control_errors
from compute.calibration.assessment.diagnosis import box_points
from compute.calibration.result import (
    Calibration,
    CrossValidation,
    count_readings,
    effective_readings,
    measurement_sigma,
    repaired_readings,
)
from compute.camera.stack import CameraStack
from service.api.calibrations.comparison import Comparison, predicted_readings
from service.api.calibrations.schema import LengthErrors

Array = NDArray[np.float64]

SUSPICIOUS_SIGMA = 3.5
"""Residuals larger than this are listed, in standard deviations."""


Relation = Literal["before", "active", "chosen"]


@dataclass(frozen=True)
class ComparedCalibration:
    """Another calibration beside the one that is reported.

    Args:
        name: its id.
        relation: whether it was active before this one, is active now, or was asked for.
        comparison: the differences.
    """

    name: str
    relation: Relation
    comparison: Comparison


@dataclass(frozen=True)
class ReportContent:
    """A calibration and the observations that it rests on.

    Args:
        title: what stands at the top.
        calibration: the calibration.
        names: of the N control points, in the order in which they were measured.
        points_mm: shape (N, 3) [mm]; N may be 0.
        readings_px: as they were given, shape (N, S) [px], NaN where not seen.
        sigma_px: the readings' own deviations, shape (N, S) [px]; None: not given.
        provenance: what is known of where it comes from, in words, by name.
        compared: another calibration that it is compared with, the second of the two in the
            comparison; None: there is none.
        lengths_left_out: errors of a waved target's lengths at poses that were held out; None: it
            is not of a wave.
    """

    title: str
    calibration: Calibration
    names: Sequence[str]
    points_mm: Array
    readings_px: Array
    sigma_px: Array | None = None
    provenance: Mapping[str, str] = field(default_factory=dict)
    compared: ComparedCalibration | None = None
    lengths_left_out: LengthErrors | None = None

    @property
    def sensors(self) -> tuple[str, ...]:
        """The sensors' names."""
        return tuple(model.name for model in self.calibration.models)

    @cached_property
    def stack(self) -> CameraStack:
        """The cameras."""
        return CameraStack.of(self.calibration.models)

    @cached_property
    def residuals_px(self) -> Array:
        """Fitted minus measured readings, shape (N, S) [px]; NaN where not seen."""
        rows = self.calibration.residuals_px
        if len(rows) != len(self.points_mm):
            return np.full(self.readings_px.shape, np.nan)
        return np.array(rows, dtype=np.float64).reshape(self.readings_px.shape)

    @cached_property
    def reading_sigma_px(self) -> Array:
        """Deviations of the readings as the calibration took them, shape (N, S) [px]."""
        own = np.array([fit.sigma_px for fit in self.calibration.sensors])
        _, given = repaired_readings(self.calibration, self.readings_px, self.sigma_px)
        if given is None:
            return np.broadcast_to(own, self.readings_px.shape)
        return np.where(np.isfinite(given), given, own)

    @cached_property
    def repaired_px(self) -> Array:
        """The readings that the residuals are of, shape (N, S) [px]; NaN where not seen."""
        return repaired_readings(self.calibration, self.readings_px)[0]

    @cached_property
    def fitted_errors_mm(self) -> Array:
        """Reconstructed minus given control points, shape (N, 3) [mm]."""
        if not len(self.points_mm):
            return np.empty((0, 3))
        errors, _ = control_errors(
            self.calibration, self.points_mm, self.readings_px, self.sigma_px
        )
        return errors

    def left_out_mm(self, check: CrossValidation) -> Array:
        """Return the errors of a cross-validation, shape (N, 3) [mm]; NaN where there is none."""
        rows = [(np.nan,) * 3 if row is None else row for row in check.differences_mm]
        return np.array(rows, dtype=np.float64).reshape(-1, 3)

    def count_readings(self, differences_mm: Array) -> int:
        """Return how many readings that were used the points (N, 3) rest on; NaN: no point."""
        used, _ = effective_readings(self.calibration, self.readings_px)
        return count_readings(used, differences_mm)

    @cached_property
    def volume_mm(self) -> tuple[Array, Array] | None:
        """Corners of the control points' box; None without any."""
        if not len(self.points_mm):
            return None
        return self.points_mm.min(axis=0), self.points_mm.max(axis=0)

    def uncertainty_mm(self, points_mm: Array) -> Array:
        """Return sigma of points by noise and calibration along X, Y, Z, shape (N, 3) [mm]."""
        from compute.reconstruction.triangulation import reconstruct

        readings = predicted_readings(self.calibration, points_mm)
        found = reconstruct(
            self.calibration.models,
            readings,
            measurement_sigma(self.calibration, readings),
            np.array(self.calibration.covariance),
        )
        variance = np.diagonal(found.covariance_mm2, axis1=1, axis2=2)
        deviation: Array = np.sqrt(np.where(variance >= 0.0, variance, np.nan))
        return deviation

    @cached_property
    def volume_uncertainty_mm(self) -> Array:
        """Deviations on a grid over the control points' box, shape (M, 3) [mm]; empty without."""
        if self.volume_mm is None:
            return np.empty((0, 3))
        return self.uncertainty_mm(box_points(*self.volume_mm, 7))

    @cached_property
    def suspicious(self) -> list[tuple[str, str, float, float]]:
        """Largest residuals: point, sensor, residual [px], residual over sigma; largest first."""
        residuals = self.residuals_px
        ratio = np.abs(residuals) / self.reading_sigma_px
        large = [
            (self.names[row], self.sensors[k], float(residuals[row, k]), float(ratio[row, k]))
            for row, k in np.argwhere(ratio > SUSPICIOUS_SIGMA)
        ]
        return sorted(large, key=lambda item: -item[3])
