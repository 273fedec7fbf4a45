"""Loss of a bundle adjustment: squared residuals or Huber loss, with priors."""

from collections.abc import Sequence
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.normal_equations import AdjustmentState
from compute.calibration.bundle_adjustment.sensor_prior import SensorPrior
from compute.robust_statistics import MAD_TO_SIGMA

Array = NDArray[np.float64]
Loss = Literal["linear", "robust"]

HUBER_LIMIT: Final = 3.0
"""Residual, in standard deviations, beyond which it counts by its size and not by its square
(Huber, doi:10.1214/aoms/1177703732): of good readings 0.3 % lie beyond, so that the covariance is
that of least squares; an outlier has no more influence than a residual of three standard
deviations."""


def total_loss(
    state: AdjustmentState, residuals: Sequence[Array], prior: SensorPrior | None, limit: float
) -> float:
    """Return the loss of a state; NaN with an observed marker behind a lens.

    Args:
        state: sensors and poses.
        residuals: over sigma, shape (B, K, S) for each pose set.
        prior: of the sensors, or None.
        limit: beyond this residual Huber's linear loss holds; inf: squares only.
    """
    total = 0.0
    for poses, residual in zip(state.pose_sets, residuals, strict=True):
        size = np.abs(residual)
        if np.isfinite(limit):
            total += float(np.where(size <= limit, size**2, 2.0 * limit * size - limit**2).sum())
        else:
            total += float((size**2).sum())
        placed = poses.prior()
        if placed is not None:
            away, information = placed
            total += float(np.einsum("bi,bij,bj->", away, information, away))
        total += float((poses.shape.equations()[0] ** 2).sum())
    if prior is not None:
        away = prior.difference(state.models)[0]
        total += float(away @ prior.information @ away)
    return total


def loss_weights(residuals: Sequence[Array], limit: float) -> list[Array]:
    """Return the weights of iteratively reweighted least squares.

    Args:
        residuals: over sigma, shape (B, K, S) for each pose set.
        limit: Huber's limit; inf: all weights are 1.

    Returns:
        Weights, shape (B, K, S) for each set.
    """
    return [
        limit / np.maximum(np.abs(one), limit) if np.isfinite(limit) else np.ones_like(one)
        for one in residuals
    ]


def robust_scale(state: AdjustmentState, residuals: Sequence[Array]) -> float:
    """Estimate the residuals' scale from their median absolute value; at least 1.

    Args:
        state: sensors and poses.
        residuals: over sigma, shape (B, K, S) for each pose set.
    """
    seen = [r[poses.seen] for r, poses in zip(residuals, state.pose_sets, strict=True)]
    together = np.abs(np.concatenate(seen))
    return max(1.0, MAD_TO_SIGMA * float(np.median(together))) if len(together) else 1.0
