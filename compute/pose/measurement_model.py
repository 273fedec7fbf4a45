"""MeasurementModel: what sensors read of markers, with all that is uncertain about the sensors.

The calibration's error is one for all markers and all frames. It is written as ``L e`` with
``L L'`` the cameras' covariance and e of independent unit normals, the *common* errors, so that a
reading's error is ``G e`` plus its own noise: fits put ``G G'`` into the readings' covariance over
all markers at once, and filters carry the pose's correlation with e along.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.mapping.table import CorrectionTable
from compute.reconstruction.triangulation import check_corrections

Array = NDArray[np.float64]

_NEWTON_STEPS = 4
_NEGLIGIBLE = 1e-14
"""Parts of the cameras' covariance this much smaller than the largest, in units of each
parameter's own deviation, are rounding."""


@dataclass(frozen=True, eq=False)
class ExpectedReadings:
    """What S sensors are expected to read of N markers at known places.

    Args:
        value_px: readings as the sensors give them, shape (N, S) [px]; NaN behind a lens.
        gradient_px_per_mm: their derivatives by the place, shape (N, S, 3).
        common_px: their derivatives by the common errors, shape (N, S, E); E is 0 for exactly
            known cameras.
        table_variance_px2: variance of the correction table there, shape (N, S); 0 without one.
        inside: whether the correction table vouches for it, shape (N, S); true without one.
    """

    value_px: Array
    gradient_px_per_mm: Array
    common_px: Array
    table_variance_px2: Array
    inside: NDArray[np.bool_]

    def part(self, first: int, last: int) -> "ExpectedReadings":
        """Return those of the markers from ``first`` to before ``last``."""
        return ExpectedReadings(*(getattr(self, name)[first:last] for name in vars(self)))


@dataclass(frozen=True, eq=False)
class MeasurementModel:
    """Cameras, their joint covariance and the correction table, made once for a calibration.

    Args:
        cameras: S calibrated cameras.
        parameter_covariance: joint covariance of their parameters, as of ``reconstruct``; None:
            taken as exact.
        corrections: of their readings, over space; None: none.

    Raises:
        InvalidParameter: the table is of another number of sensors.
    """

    cameras: CameraStack
    parameter_covariance: Array | None = None
    corrections: CorrectionTable | None = None

    def __post_init__(self) -> None:
        check_corrections(self.cameras, self.corrections)

    @classmethod
    def of(
        cls,
        cameras: Sequence[SensorModel] | CameraStack,
        parameter_covariance: Array | None = None,
        corrections: CorrectionTable | None = None,
    ) -> "MeasurementModel":
        """Return the model of cameras one by one or stacked."""
        stack = cameras if isinstance(cameras, CameraStack) else CameraStack.of(cameras)
        return cls(stack, parameter_covariance, corrections)

    @property
    def sensors(self) -> int:
        """How many there are."""
        return len(self.cameras)

    @cached_property
    def common(self) -> Array:
        """Columns L of the cameras' covariance ``L L'``, by sensor, shape (S, width, E)."""
        cameras = self.cameras
        if self.parameter_covariance is None:
            return np.empty((len(cameras), cameras.width, 0))
        spread = cameras.covariance_blocks(np.asarray(self.parameter_covariance))
        full = spread.reshape(cameras.parameter_index.size, cameras.parameter_index.size)
        scale = np.sqrt(np.diagonal(full))
        scale = np.where(scale > 0.0, scale, 1.0)
        values, vectors = np.linalg.eigh(full / (scale[:, None] * scale))
        kept = values > _NEGLIGIBLE * max(float(values[-1]), 0.0)
        columns: Array = scale[:, None] * vectors[:, kept] * np.sqrt(values[kept])
        return columns.reshape(len(cameras), cameras.width, -1)

    def expected(self, points_mm: Array) -> tuple[Array, Array]:
        """Return expected raw readings (N, S) [px] and their slopes (N, S, 3) of points (N, 3)."""
        value, slope = self.cameras.linearise(points_mm)
        if self._has_cubic_distortion:
            value, gain = self._undistort_inverse(value)
            slope = slope * gain[..., None]
        if self.corrections is not None:
            # It is added to a reading, so it is subtracted from what is expected.
            correction = self.corrections.at(points_mm)
            value = value - correction.value_px
            slope = slope - correction.gradient_px_per_mm
        return value, slope

    @cached_property
    def _has_cubic_distortion(self) -> bool:
        return bool(self.cameras.cubic_per_px2.any())

    def _undistort_inverse(self, corrected_px: Array) -> tuple[Array, Array]:
        """Return readings p with ``p + D (p - p0)^3`` as given, [5.12], and d p / d corrected."""
        reading = corrected_px
        for _ in range(_NEWTON_STEPS):
            off = self.cameras.add_cubic_term(reading) - corrected_px
            reading = reading - off / self.cameras.correction_derivative(reading)
        return reading, 1.0 / self.cameras.correction_derivative(reading)

    def common_jacobian(self, points_mm: Array) -> Array:
        """Return d reading / d common errors, shape (N, S, E), of points (N, 3)."""
        columns = self.common
        if columns.shape[2] == 0:
            return np.zeros((len(points_mm), self.sensors, 0))
        projected, by_parameter = self.cameras.project_with_parameter_jacobian(points_mm)
        if self._has_cubic_distortion:
            by_parameter = by_parameter * self._undistort_inverse(projected)[1][..., None]
        common: Array = (by_parameter.transpose(1, 0, 2) @ columns).transpose(1, 0, 2)
        return common

    def full(self, points_mm: Array) -> ExpectedReadings:
        """Return all that is expected of points (N, 3)."""
        value, slope = self.expected(points_mm)
        variance = np.zeros(value.shape)
        inside = np.ones(value.shape, dtype=np.bool_)
        if self.corrections is not None:
            known = self.corrections.at(points_mm)
            variance, inside = np.nan_to_num(known.variance_px2), known.inside
        return ExpectedReadings(value, slope, self.common_jacobian(points_mm), variance, inside)
