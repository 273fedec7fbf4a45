"""How far a reading can be trusted under a calibration: its noise and the model's misfit."""

import numpy as np
from numpy.typing import NDArray

from compute.calibration.result import Calibration

Array = NDArray[np.float64]


def reading_sigma(
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
    own = np.array([fit.sigma_px for fit in calibration.sensors])
    excess = np.array([max((fit.chi2_per_dof or 1.0) - 1.0, 0.0) for fit in calibration.sensors])
    least = np.array(
        [fit.sigma_px if fit.sigma_source == "residuals" else 0.0 for fit in calibration.sensors]
    )
    sigma = np.broadcast_to(own if sigma_px is None else sigma_px, readings_px.shape)
    sigma = np.where(np.isnan(sigma), own, sigma)
    trusted: Array = np.maximum(np.hypot(sigma, own * np.sqrt(excess)), least)
    return trusted
