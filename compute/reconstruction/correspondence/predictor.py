"""Predictor: what sensors would read of points that three of them, or a track, suggest."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.mapping.table import CorrectionTable
from compute.reconstruction.triangulation import check_corrections

Array = NDArray[np.float64]

_SAMPLE = 64
_CUBIC_STEPS = 3


@dataclass(frozen=True, eq=False)
class Prediction:
    """Readings of N points by S sensors.

    Args:
        readings_px: shape (N, S) [px]; NaN behind a lens.
        jacobian_px_per_mm: d reading / d point, shape (N, S, 3).
        variance_px2: what the cameras' and the table's own uncertainty add, shape (S,): the
            largest of some of the points.
        in_view: whether the reading lies on the sensor's pixels, shape (N, S).
    """

    readings_px: Array
    jacobian_px_per_mm: Array
    variance_px2: Array
    in_view: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Predictor:
    """Predicts readings; made once for a calibration.

    Args:
        cameras: S cameras.
        parameter_covariance: as of ``reconstruct``.
        corrections: as of ``reconstruct``.
        pixels: of each sensor's line, S of them; None: not known, every reading is in view.

    Raises:
        InvalidParameter: the table is of another number of sensors.
    """

    cameras: CameraStack
    parameter_covariance: Array | None = None
    corrections: CorrectionTable | None = None
    pixels: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        check_corrections(self.cameras, self.corrections)

    @classmethod
    def of(
        cls,
        models: Sequence[SensorModel],
        parameter_covariance: Array | None = None,
        corrections: CorrectionTable | None = None,
    ) -> "Predictor":
        """Return the predictor of sensor models."""
        pixels = tuple(model.pixels for model in models)
        return cls(CameraStack.of(models), parameter_covariance, corrections, pixels)

    def __call__(self, points_mm: Array) -> Prediction:
        """Return what the sensors read of points (N, 3) [mm]; NaN where a point is NaN."""
        cameras = self.cameras
        # A reading q is corrected to q + D (q - p0)^3, [5.12], which is inverted by iteration.
        projected, slope = cameras.linearise(points_mm)
        readings = projected
        if cameras.cubic_per_px2.any():
            for _ in range(_CUBIC_STEPS):
                readings = projected - (cameras.add_cubic_term(readings) - readings)
            slope = slope / cameras.correction_derivative(readings)[..., None]
        variance = np.zeros(len(cameras))
        if self.corrections is not None:
            there = self.corrections.at(points_mm)
            readings = readings - there.value_px
            if len(points_mm):
                variance += np.nan_to_num(there.variance_px2).max(axis=0)
        if self.parameter_covariance is not None and len(points_mm):
            variance += self._calibration_variance(points_mm)
        in_view = np.isfinite(readings)
        if self.pixels is not None:
            with np.errstate(invalid="ignore"):
                in_view &= (readings >= -0.5) & (readings <= np.array(self.pixels) - 0.5)
        return Prediction(readings, slope, variance, in_view)

    def _calibration_variance(self, points_mm: Array) -> Array:
        sample = points_mm[:: max(1, len(points_mm) // _SAMPLE)]
        jacobian = np.nan_to_num(self.cameras.parameter_jacobian(sample))
        blocks = self.cameras.covariance_blocks(np.asarray(self.parameter_covariance))
        sensor = np.arange(len(self.cameras))
        own = blocks[sensor, :, sensor, :]
        variance: Array = np.einsum("nsp,spq,nsq->ns", jacobian, own, jacobian).max(axis=0)
        return variance
