"""MeasurementModel: what the sensors would read of markers at given places, as they give it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.mapping.table import CorrectionTable
from compute.reconstruction.triangulation import check_corrections

Array = NDArray[np.float64]

_TURNS = 8
"""Newton's steps for the cubic distortion's inverse; the fourth is at rounding already."""


@dataclass(frozen=True, eq=False)
class PredictedMeasurements:
    """Readings of T places.

    Args:
        reading_px: as the sensors give them, before any correction, shape (T, S); NaN behind a
            lens.
        jacobian: d reading / d place, shape (T, S, 3) [px/mm].
        in_view: whether a sensor has pixels there, shape (T, S).
    """

    reading_px: Array
    jacobian: Array
    in_view: NDArray[np.bool_]


class MeasurementModel:
    """Projection by the cameras, less what a correction table adds to readings there.

    Peaks stay as they are found: not they are corrected at each track's place, but the prediction
    is made uncorrected, which is the same and is done once for all peaks.

    Args:
        cameras: S calibrated cameras.
        parameter_covariance: as of ``reconstruct``; None: cameras are exact.
        corrections: of the S sensors' readings; None: none.
        pixels: of each sensor; None: every place before its lens is in a sensor's view.

    Raises:
        InvalidParameter: a covariance, table or number of pixels of other sensors.
    """

    def __init__(
        self,
        cameras: CameraStack,
        parameter_covariance: Array | None = None,
        corrections: CorrectionTable | None = None,
        pixels: tuple[int, ...] | None = None,
    ) -> None:
        check_corrections(cameras, corrections)
        count = int(cameras.parameter_mask.sum())
        if parameter_covariance is not None and np.shape(parameter_covariance) != (count, count):
            raise InvalidParameter(
                f"the parameters' covariance has the shape {np.shape(parameter_covariance)}; the "
                f"cameras have {count} parameters"
            )
        if pixels is not None and (len(pixels) != len(cameras) or min(pixels) < 1):
            raise InvalidParameter(
                f"pixels is {pixels}; it must name 1 or more for each of {len(cameras)} sensors"
            )
        self.cameras = cameras
        self.corrections = corrections
        self.exact = parameter_covariance is None and corrections is None
        self.last_px = np.full(len(cameras), np.inf) if pixels is None else np.array(pixels) - 0.5
        self.first_px = -self.last_px if pixels is None else np.full(len(cameras), -0.5)
        self._cubic = bool(np.any(cameras.cubic_per_px2 != 0.0))
        self._blocks = (
            None
            if parameter_covariance is None
            else cameras.covariance_blocks(np.asarray(parameter_covariance))
        )

    def __len__(self) -> int:
        """Return the number of sensors."""
        return len(self.cameras)

    def predict(self, positions_mm: Array) -> PredictedMeasurements:
        """Return the readings of places (T, 3) [mm]."""
        corrected, jacobian = self.cameras.linearise(positions_mm)
        reading, by_corrected = self._uncorrected(corrected)
        if by_corrected is not None:
            jacobian = jacobian * by_corrected[..., None]
        if self.corrections is not None:
            correction = self.corrections.at(positions_mm)
            reading = reading - correction.value_px
            jacobian = jacobian - correction.gradient_px_per_mm
        in_view = (reading >= self.first_px) & (reading <= self.last_px)
        return PredictedMeasurements(reading, jacobian, in_view)

    def bias_covariance(self, positions_mm: Array) -> Array:
        """Return the covariance of the readings' constant errors there, shape (T, S, S) [px^2].

        By the cameras' own covariance, and by the table's variance, which stays the same as long
        as a marker stays where it is.
        """
        sensors = len(self)
        covariance = np.zeros((len(positions_mm), sensors, sensors))
        if self._blocks is not None:
            corrected, parameter_jacobians = self.cameras.project_with_parameter_jacobian(
                positions_mm
            )
            _, by_corrected = self._uncorrected(corrected)
            if by_corrected is not None:
                parameter_jacobians = parameter_jacobians * by_corrected[..., None]
            parameter_jacobians = np.nan_to_num(parameter_jacobians)
            for one, jacobian in enumerate(parameter_jacobians):
                half = np.einsum("sp,sptq->stq", jacobian, self._blocks)
                covariance[one] = np.einsum("stq,tq->st", half, jacobian)
        if self.corrections is not None:
            diagonal = np.arange(sensors)
            known = np.nan_to_num(self.corrections.at(positions_mm).variance_px2)
            covariance[:, diagonal, diagonal] += known
        return covariance

    def inside_hull(self, positions_mm: Array) -> NDArray[np.bool_]:
        """Return whether the table vouches for each sensor's reading there, shape (T, S)."""
        if self.corrections is None:
            return np.ones((len(positions_mm), len(self)), dtype=np.bool_)
        inside: NDArray[np.bool_] = self.corrections.at(positions_mm).inside
        return inside

    def _uncorrected(self, corrected_px: Array) -> tuple[Array, Array | None]:
        """Undo [5.12]: readings that correct to these, and d reading / d corrected (None: 1)."""
        if not self._cubic:
            return corrected_px, None
        reading = corrected_px
        for _ in range(_TURNS):
            off = self.cameras.add_cubic_term(reading) - corrected_px
            reading = reading - off / self.cameras.correction_derivative(reading)
        return reading, 1.0 / self.cameras.correction_derivative(reading)
