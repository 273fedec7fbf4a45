"""What a calibration run yields: the sensor models, their joint covariance, the residuals."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import SensorModel, Vector3, vector3

Method = Literal["metric", "dlt-iterative"]


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
        deviation = rows.std(axis=0, ddof=1) if len(rows) > 1 else np.zeros(3)
        return cls(
            len(rows),
            vector3(absolute.mean(axis=0)),
            vector3(absolute.max(axis=0)),
            vector3(rows.mean(axis=0)),
            vector3(deviation),
        )


@dataclass(frozen=True)
class Calibration:
    """The camera models of one device, with what is known of their errors.

    Args:
        method: how it was made.
        sensors: one fit for each sensor, in the device's order.
        covariance: joint covariance of all parameters, shape (7 S, 7 S), sensor by sensor in the
            order of ``compute.camera.model.PARAMETERS``.
        residuals_px: fitted minus measured reading [px], shape (N, S); None where not seen.
    """

    method: Method
    sensors: tuple[SensorFit, ...]
    covariance: tuple[tuple[float, ...], ...]
    residuals_px: tuple[tuple[float | None, ...], ...]

    @property
    def models(self) -> tuple[SensorModel, ...]:
        """The camera models in the device's order."""
        return tuple(fit.model for fit in self.sensors)
