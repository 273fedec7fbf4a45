"""How far a reading can be trusted under a calibration: its noise and the model's misfit."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from compute.calibration.result import Calibration

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
