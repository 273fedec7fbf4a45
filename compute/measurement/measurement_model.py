"""MeasurementModel: raw readings of points by calibrated cameras and their correction table.

The calibration's error is one for all markers and all exposures. It is written as ``L e`` with
``L L'`` the covariance of the cameras' parameters and e independent unit normals, the *common
errors*, so that a reading's error is ``G e`` plus its own noise. Fits put ``G G'`` into the
covariance of the readings of all markers at once; filters carry the state's correlation with e.

Two forms of the same model: ``predict`` and ``linearise`` give what a sensor reads, which filters
and association compare with peaks as they were found; ``residuals`` gives the condition that a
reading and a point fulfil, in corrected pixels, which needs no inverse of the cubic distortion.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.mapping.table import Corrections, CorrectionTable

Array = NDArray[np.float64]

_NEGLIGIBLE = 1e-14
"""Eigenvalues of the parameters' correlation matrix this much below the largest are rounding."""


@dataclass(frozen=True, eq=False)
class PredictedMeasurements:
    """Predicted readings of N points by S sensors.

    Args:
        reading_px: raw readings, shape (N, S) [px]; NaN behind a lens.
        jacobian_px_per_mm: d reading / d point, the correction table's included, shape (N, S, 3).
        in_view: whether the reading lies on the sensor's pixels, shape (N, S).
        table_variance_px2: variance of the correction table there, shape (N, S); 0 without one.
        inside_hull: whether the correction table is valid there, shape (N, S); true without one.
        common_jacobian_px: d reading / d common errors, shape (N, S, E); E is 0 for exactly known
            cameras and where it was not asked for.
    """

    reading_px: Array
    jacobian_px_per_mm: Array
    in_view: NDArray[np.bool_]
    table_variance_px2: Array
    inside_hull: NDArray[np.bool_]
    common_jacobian_px: Array

    def part(self, first: int, last: int) -> "PredictedMeasurements":
        """Return a range of the points; the arrays are shared.

        Args:
            first: index of the first point.
            last: index after the last point.
        """
        return PredictedMeasurements(*(values[first:last] for values in vars(self).values()))


@dataclass(frozen=True, eq=False)
class MeasurementModel:
    """Cameras, the covariance of their parameters and the correction table of one calibration.

    Args:
        cameras: S calibrated cameras.
        parameter_covariance: joint covariance of the cameras' P parameters, shape (P, P), sensor
            by sensor in the order of ``SensorModel.parameter_names``. None: taken as exact.
        corrections: corrections of the S sensors' readings, over space. None: none.
        pixels: number of pixels of each sensor. None: every reading is in view.

    Raises:
        InvalidParameter: a covariance, table or number of pixels of other sensors.
    """

    cameras: CameraStack
    parameter_covariance: Array | None = None
    corrections: CorrectionTable | None = None
    pixels: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        check_calibration(self.cameras, self.parameter_covariance, self.corrections)
        pixels = self.pixels
        if pixels is not None and (len(pixels) != len(self.cameras) or min(pixels) < 1):
            raise InvalidParameter(
                f"pixels is {pixels}; it must name 1 or more for each of {len(self.cameras)} "
                "sensors"
            )

    @classmethod
    def of(
        cls,
        models: Sequence[SensorModel] | CameraStack,
        parameter_covariance: Array | None = None,
        corrections: CorrectionTable | None = None,
    ) -> "MeasurementModel":
        """Return the measurement model of cameras; sensor models give their numbers of pixels.

        Args:
            models: S calibrated cameras, one by one or stacked.
            parameter_covariance: joint covariance of their parameters, shape (P, P); None: exact.
            corrections: correction table of the S sensors; None: none.

        Raises:
            InvalidParameter: a covariance or table of other sensors.
        """
        if isinstance(models, CameraStack):
            return cls(models, parameter_covariance, corrections)
        pixels = tuple(model.pixels for model in models)
        return cls(CameraStack.of(models), parameter_covariance, corrections, pixels)

    def __len__(self) -> int:
        """Return the number of sensors."""
        return len(self.cameras)

    @property
    def exact(self) -> bool:
        """Whether cameras and readings are taken as free of systematic error."""
        return self.parameter_covariance is None and self.corrections is None

    @cached_property
    def first_px(self) -> Array:
        """First edge of each sensor's pixels, shape (S,); minus infinity where not known."""
        return np.full(len(self), -np.inf if self.pixels is None else -0.5)

    @cached_property
    def last_px(self) -> Array:
        """Last edge of each sensor's pixels, shape (S,); infinity where not known."""
        return np.full(len(self), np.inf) if self.pixels is None else np.array(self.pixels) - 0.5

    @cached_property
    def has_cubic_distortion(self) -> bool:
        """Whether any camera has the cubic distortion of thesis [5.12]."""
        return bool(self.cameras.cubic_per_px2.any())

    @cached_property
    def covariance_blocks(self) -> Array | None:
        """Parameter covariance by sensor, shape (S, width, S, width); None: cameras are exact."""
        if self.parameter_covariance is None:
            return None
        return self.cameras.covariance_blocks(np.asarray(self.parameter_covariance))

    @cached_property
    def covariance_factor(self) -> Array:
        """Factor L of the parameter covariance ``L L'``, by sensor, shape (S, width, E)."""
        cameras = self.cameras
        blocks = self.covariance_blocks
        if blocks is None:
            return np.empty((len(cameras), cameras.width, 0))
        full = blocks.reshape(cameras.parameter_index.size, cameras.parameter_index.size)
        scale = np.sqrt(np.diagonal(full))
        scale = np.where(scale > 0.0, scale, 1.0)
        values, vectors = np.linalg.eigh(full / (scale[:, None] * scale))
        significant = values > _NEGLIGIBLE * max(float(values[-1]), 0.0)
        columns: Array = scale[:, None] * vectors[:, significant] * np.sqrt(values[significant])
        return columns.reshape(len(cameras), cameras.width, -1)

    def linearise(self, points_mm: Array) -> tuple[Array, Array]:
        """Predict raw readings (N, S) [px] and d reading / d point (N, S, 3) of points (N, 3)."""
        reading, jacobian, _ = self._linearise(points_mm)
        return reading, jacobian

    def predict(
        self, points_mm: Array, *, with_common_errors: bool = False
    ) -> PredictedMeasurements:
        """Predict raw readings with Jacobians, view, and the correction table's variance.

        Args:
            points_mm: shape (N, 3) [mm]; NaN: no point.
            with_common_errors: whether to fill ``common_jacobian_px``.
        """
        reading, jacobian, correction = self._linearise(points_mm)
        if correction is None:
            variance = np.zeros(reading.shape)
            inside = np.ones(reading.shape, dtype=np.bool_)
        else:
            variance, inside = np.nan_to_num(correction.variance_px2), correction.inside
        # NaN compares as false.
        in_view = (reading >= self.first_px) & (reading <= self.last_px)
        common = (
            self.common_jacobian(points_mm) if with_common_errors else np.zeros((*reading.shape, 0))
        )
        return PredictedMeasurements(reading, jacobian, in_view, variance, inside, common)

    def common_jacobian(self, points_mm: Array) -> Array:
        """Return d reading / d common errors of points (N, 3), shape (N, S, E) [px]."""
        factor = self.covariance_factor
        if factor.shape[2] == 0:
            return np.zeros((len(points_mm), len(self), 0))
        by_parameter = self.parameter_jacobian(points_mm)
        common: Array = (by_parameter.transpose(1, 0, 2) @ factor).transpose(1, 0, 2)
        return common

    def parameter_jacobian(self, points_mm: Array) -> Array:
        """Return d reading / d parameters of points (N, 3), shape (N, S, width)."""
        projected, jacobian = self.cameras.project_with_parameter_jacobian(points_mm)
        if self.has_cubic_distortion:
            jacobian = jacobian * self._invert_cubic(projected)[1][..., None]
        return jacobian

    def systematic_covariance(self, points_mm: Array) -> Array:
        """Return the covariance of the readings' constant errors at points (N, 3).

        The cameras' own covariance, and the table's variance, which stays the same as long as a
        marker stays where it is.

        Returns:
            Shape (N, S, S) [px^2].
        """
        sensors = len(self)
        covariance = np.zeros((len(points_mm), sensors, sensors))
        if self.covariance_blocks is not None:
            for one, jacobian in enumerate(np.nan_to_num(self.parameter_jacobian(points_mm))):
                half = np.einsum("sp,sptq->stq", jacobian, self.covariance_blocks)
                covariance[one] = np.einsum("stq,tq->st", half, jacobian)
        if self.corrections is not None:
            diagonal = np.arange(sensors)
            table_variance = np.nan_to_num(self.corrections.at(points_mm).variance_px2)
            covariance[:, diagonal, diagonal] += table_variance
        return covariance

    def calibration_variance(self, points_mm: Array) -> Array:
        """Return each reading's variance by the cameras' own covariance, shape (N, S) [px^2]."""
        blocks = self.covariance_blocks
        if blocks is None:
            return np.zeros((len(points_mm), len(self)))
        jacobian = np.nan_to_num(self.parameter_jacobian(points_mm))
        sensor = np.arange(len(self))
        sensor_blocks = blocks[sensor, :, sensor, :]
        variance: Array = np.einsum("nsp,spq,nsq->ns", jacobian, sensor_blocks, jacobian)
        return variance

    def inside_hull(self, points_mm: Array) -> NDArray[np.bool_]:
        """Return whether the table is valid for each sensor at points (N, 3), shape (N, S)."""
        if self.corrections is None:
            return np.ones((len(points_mm), len(self)), dtype=np.bool_)
        inside: NDArray[np.bool_] = self.corrections.at(points_mm).inside
        return inside

    def in_box(self, points_mm: Array) -> NDArray[np.bool_]:
        """Return at which points (N, 3) covariances are known, shape (N,): in the table's box."""
        if self.corrections is None:
            return np.ones(len(points_mm), dtype=np.bool_)
        return self.corrections.grid.contains(points_mm)

    def residuals(self, readings_px: Array, points_mm: Array) -> tuple[Array, Array]:
        """Return residuals of raw readings in corrected pixels, and their negative Jacobian.

        The residual is the corrected reading less the projection. Divided by ``d corrected /
        d reading`` it is the raw reading less the predicted one, to first order.

        Args:
            readings_px: raw readings, shape (N, S) [px].
            points_mm: shape (N, 3) [mm].

        Returns:
            Residuals (N, S) [px] and - d residual / d point (N, S, 3) [px/mm].
        """
        reading = readings_px
        projected, jacobian = self.cameras.linearise(points_mm)
        if self.corrections is not None:
            correction = self.corrections.at(points_mm)
            reading = reading + correction.value_px
            by_reading = self.cameras.correction_derivative(reading)[..., None]
            jacobian -= by_reading * correction.gradient_px_per_mm
        return self.cameras.add_cubic_term(reading) - projected, jacobian

    def whitening(self, points_mm: Array, variance_px2: Array, used: NDArray[np.bool_]) -> Array:
        """Return W with ``W S W' = 1`` for the covariance S of corrected readings.

        Args:
            points_mm: shape (N, 3) [mm].
            variance_px2: variances of the corrected readings by themselves, shape (N, S) [px^2].
            used: which readings count; others are taken as free of the cameras' errors, (N, S).

        Returns:
            Shape (N, S, S) [1/px].
        """
        if self.covariance_blocks is None:
            return np.eye(len(self)) / np.sqrt(variance_px2)[:, :, None]
        jacobian = np.nan_to_num(self.cameras.parameter_jacobian(points_mm)) * used[..., None]
        covariance: Array = np.einsum(
            "nsp,sptq,ntq->nst", jacobian, self.covariance_blocks, jacobian
        )
        diagonal = np.arange(len(self))
        covariance[:, diagonal, diagonal] += variance_px2
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), dtype=np.float64)

    def _linearise(self, points_mm: Array) -> tuple[Array, Array, Corrections | None]:
        """Return raw readings, their Jacobian by the point, and the table's correction there."""
        reading, jacobian = self.cameras.linearise(points_mm)
        if self.has_cubic_distortion:
            reading, derivative = self._invert_cubic(reading)
            jacobian = jacobian * derivative[..., None]
        if self.corrections is None:
            return reading, jacobian, None
        # A correction is added to a reading, so it is subtracted from what is expected.
        correction = self.corrections.at(points_mm)
        reading = reading - correction.value_px
        return reading, jacobian - correction.gradient_px_per_mm, correction

    def _invert_cubic(self, corrected_px: Array) -> tuple[Array, Array]:
        """Return raw readings, and d raw / d corrected."""
        cameras = self.cameras
        reading = invert_cubic(corrected_px, cameras.principal_point_px, cameras.cubic_per_px2)
        return reading, 1.0 / cameras.correction_derivative(reading)


def check_calibration(
    cameras: CameraStack, parameter_covariance: Array | None, corrections: CorrectionTable | None
) -> None:
    """Refuse a covariance or a correction table that is not that of the cameras.

    Args:
        cameras: S cameras with P parameters.
        parameter_covariance: must have the shape (P, P); None: none.
        corrections: the table, which must be of S sensors; None: none.

    Raises:
        InvalidParameter: a covariance of another shape, or a table of other sensors.
    """
    if corrections is not None and len(corrections.sensors) != len(cameras):
        raise InvalidParameter(
            f"the correction table is of {len(corrections.sensors)} sensors; there are "
            f"{len(cameras)} cameras"
        )
    count = int(cameras.parameter_mask.sum())
    if parameter_covariance is not None and np.shape(parameter_covariance) != (count, count):
        raise InvalidParameter(
            f"the parameters' covariance has the shape {np.shape(parameter_covariance)}; the "
            f"cameras have {count} parameters"
        )


def invert_cubic(corrected_px: Array, principal_point_px: Array, cubic_per_px2: Array) -> Array:
    """Solve ``q + D (q - p0)^3 = p`` for the raw readings q.

    Cardano's root on the branch through p0, in its trigonometric (D < 0) and hyperbolic (D > 0)
    form, then one Newton step, which removes the rounding of the functions.

    Args:
        corrected_px: corrected readings p, shape (..., S) [px].
        principal_point_px: p0, shape (S,) [px].
        cubic_per_px2: D, shape (S,) [1/px^2].

    Returns:
        Raw readings q, shape (..., S) [px]; NaN beyond the fold ``q - p0 = 1 / sqrt(-3 D)`` of a
        negative D, where no reading corrects to p.
    """
    offset = corrected_px - principal_point_px
    # t + D t^3 = w with t = 2 x / k, k = sqrt(3 |D|), is 3 x +- 4 x^3 = 1.5 k w.
    scale = np.sqrt(3.0 * np.abs(cubic_per_px2))
    plain = scale == 0.0
    argument = 1.5 * scale * offset
    with np.errstate(invalid="ignore"):
        root = np.where(
            cubic_per_px2 < 0.0,
            np.sin(np.arcsin(argument) / 3.0),
            np.sinh(np.arcsinh(argument) / 3.0),
        )
    root = np.where(plain, offset, 2.0 * root / np.where(plain, 1.0, scale))
    slope = 1.0 + 3.0 * cubic_per_px2 * root**2
    misfit = root + cubic_per_px2 * root**3 - offset
    # At the fold itself the slope is 0 and the root is exact enough.
    root = root - np.divide(misfit, slope, out=np.zeros_like(misfit), where=slope > 1e-6)
    reading: Array = principal_point_px + root
    return reading
