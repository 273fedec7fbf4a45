"""How well each sensor fits, and the factor from its equations' inverse to its covariance."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from compute.calibration.result import SensorFit
from compute.calibration.single_sensor.sensor_fits import SIGMA_FLOOR_PX
from compute.camera.model import PARAMETER_COUNT, SensorModel
from compute.reconstruction.triangulation import chi2_limit

Array = NDArray[np.float64]

QUANTISATION_PX: Final = 1.0 / np.sqrt(12.0)
UNEXPLAINED_PROBABILITY: Final = 0.01
"""Chance that right deviations are taken for too small."""


@dataclass(frozen=True, eq=False)
class Residuals:
    """One sensor's residuals.

    Args:
        values_px: fitted minus measured of the readings that count, shape (N,).
        sigma_px: deviations that were given with them; None: none were.
        total_sigma_px: deviations that residuals are compared with, the control points' own
            uncertainty included, shape (N,); None: those given.
        chi2_values_px: residuals to compare, at the points as given; None: ``values_px``.
    """

    values_px: Array
    sigma_px: Array | None
    total_sigma_px: Array | None = None
    chi2_values_px: Array | None = None


def fit_statistics(
    model: SensorModel,
    seen: int,
    residuals: Residuals,
    iteration_change_px: float | None = None,
) -> tuple[SensorFit, float]:
    """Return the fit's figures and the factor from cofactor to covariance.

    Args:
        model: the fitted camera.
        seen: control points that it read.
        residuals: of those that count.
        iteration_change_px: see ``SensorFit``.
    """
    values = residuals.values_px
    terms = 0 if model.distortion is None else len(model.distortion.terms)
    # The offset along the slit is a parameter and its prior an observation: they cancel.
    dof = len(values) - PARAMETER_COUNT - terms
    square_sum = float((values**2).sum())
    chi2_per_dof, factor = None, 1.0
    source: Literal["given", "residuals", "assumed"]
    if residuals.sigma_px is not None:
        source, sigma = "given", float(np.sqrt((residuals.sigma_px**2).mean()))
        if dof > 0:
            compared = values if residuals.chi2_values_px is None else residuals.chi2_values_px
            sigma_px = (
                residuals.sigma_px if residuals.total_sigma_px is None else residuals.total_sigma_px
            )
            chi2 = float(((compared / sigma_px) ** 2).sum())
            chi2_per_dof = chi2 / dof
            # Residuals that the given deviations do not explain: the covariance grows with them.
            if chi2 > chi2_limit(dof, UNEXPLAINED_PROBABILITY):
                factor = chi2_per_dof
    elif dof > 2:
        # n - 9 instead of n - 7: the estimate's own uncertainty included, so that errors squared
        # over the covariance average 7, as they would with a known deviation.
        source, sigma = "residuals", max(float(np.sqrt(square_sum / (dof - 2))), SIGMA_FLOOR_PX)
        factor = sigma**2
    else:
        # One or two residuals more than parameters say too little.
        residual_sigma_px = float(np.sqrt(square_sum / max(dof, 1)))
        source, sigma = "assumed", max(float(QUANTISATION_PX), residual_sigma_px)
        factor = sigma**2
    fit = SensorFit(
        model,
        seen,
        float(np.sqrt((values**2).mean())),
        float(np.abs(values).max()),
        sigma,
        source,
        chi2_per_dof,
        iteration_change_px,
    )
    return fit, factor
