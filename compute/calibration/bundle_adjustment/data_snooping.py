"""Which readings are wrong: residuals over their own deviations (Baarda's data snooping)."""

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.adjustment_result import AdjustmentResult
from compute.camera.stack import CameraStack

Array = NDArray[np.float64]

REDUNDANCY_FLOOR = 1e-3
"""Share of a reading that others must check before its residual says anything of it."""


def redundancy(adjusted: AdjustmentResult, index: int = 0) -> Array:
    """Return which share of each reading's error shows in its residual, (B, K, S) in 0 .. 1.

    1 less the variance of the fitted reading over that of the reading; 0 where not seen.
    Baarda, A testing procedure for use in geodetic networks, 1968.
    """
    poses = adjusted.pose_sets[index]
    cameras = CameraStack.of(adjusted.models)
    marker = poses.marker_positions().reshape(-1, 3)
    full = (*poses.readings_px.shape, -1)
    _, by_place = cameras.linearise(marker)
    scale = np.where(poses.seen, 1.0 / poses.sigma_px, 0.0)[..., None]
    slope = np.nan_to_num(by_place).reshape(full) * scale
    local = slope @ poses.marker_jacobian()
    by_parameter = np.nan_to_num(cameras.parameter_jacobian(marker)).reshape(full) * scale
    size = len(adjusted.global_covariance)
    here = np.flatnonzero(cameras.parameter_mask)
    order = cameras.parameter_index.ravel()[here]
    sensors, width = cameras.parameter_index.shape
    rows = np.zeros((*poses.readings_px.shape, sensors * width))
    sensor = np.arange(sensors)[:, None]
    rows[:, :, sensor, sensor * width + np.arange(width)] = by_parameter
    by_globals = np.zeros((*poses.readings_px.shape, size))
    by_globals[..., order] = rows[..., here]
    if poses.shape.unknowns:
        first = len(here) + sum(p.shape.unknowns for p in adjusted.pose_sets[:index])
        changes = np.einsum("bij,mkj->bkim", poses.rotation, poses.shape.basis)
        by_globals[..., first : first + poses.shape.unknowns] = slope @ changes
    inverse, carried = adjusted.eliminated(index)
    by_globals -= local @ carried[:, None]
    fitted = ((by_globals @ adjusted.global_covariance) * by_globals).sum(axis=-1)
    fitted += ((local @ inverse[:, None]) * local).sum(axis=-1)
    return np.where(poses.seen, np.clip(1.0 - fitted, 0.0, 1.0), 0.0)


def normalised_residuals(adjusted: AdjustmentResult, index: int = 0) -> Array:
    """Return residuals over their own standard deviations, (B, K, S); 0 where unchecked."""
    share = redundancy(adjusted, index)
    residual = np.nan_to_num(adjusted.residuals[index])
    return np.where(
        share > REDUNDANCY_FLOOR, residual / np.sqrt(np.maximum(share, REDUNDANCY_FLOOR)), 0.0
    )
