"""The sensors' noise by their residuals, and readings that are too far off to be noise."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.adjustment_result import AdjustmentResult
from compute.calibration.bundle_adjustment.data_snooping import normalised_residuals, redundancy

Array = NDArray[np.float64]

REJECTION_LIMIT: Final = 4.5
"""Residual over its own deviation beyond which a reading is left out; of 100,000 good ones 0.7."""
SIGMA_FLOOR_PX: Final = 1e-6
"""Exact data still leave rounding."""


def sensor_sigma(adjusted: AdjustmentResult, robust: bool) -> Array:
    """Return each sensor's noise over the deviations that were taken, shape (S,).

    By residuals squared over their redundancy (variance components, Helmert's), or by the
    median of normalised residuals, which wrong readings do not move.
    """
    ratios = []
    normalised = [normalised_residuals(adjusted, i) for i in range(len(adjusted.pose_sets))]
    shares = [redundancy(adjusted, i) for i in range(len(adjusted.pose_sets))]
    for sensor in range(len(adjusted.models)):
        if robust:
            sizes = np.concatenate([np.abs(one[..., sensor]).ravel() for one in normalised])
            sizes = sizes[sizes > 0.0]
            ratios.append(1.4826 * float(np.median(sizes)) if len(sizes) else 1.0)
            continue
        squares = sum(float(np.nansum(one[..., sensor] ** 2)) for one in adjusted.residuals)
        share = sum(float(one[..., sensor].sum()) for one in shares)
        ratios.append(float(np.sqrt(squares / share)) if share > 1.0 else 1.0)
    return np.array(ratios)


def worst_readings(adjusted: AdjustmentResult, index: int) -> tuple[NDArray[np.intp], Array]:
    """Return the worst reading of each pose that holds one beyond the limit.

    One of each pose only: a wrong reading pulls at those beside it.

    Returns:
        Their places, shape (N, 3): pose, marker, sensor; and normalised residuals (N,).
    """
    normalised = normalised_residuals(adjusted, index)
    flat = np.abs(normalised).reshape(len(normalised), -1)
    worst = flat.argmax(axis=1)
    beyond = np.flatnonzero(flat.max(axis=1) > REJECTION_LIMIT)
    places = np.unravel_index(worst[beyond], normalised.shape[1:])
    where = np.stack([beyond, *places], axis=1).astype(np.intp)
    return where, normalised[tuple(where.T)]
