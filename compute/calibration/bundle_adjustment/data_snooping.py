"""Data snooping (Baarda): redundancy, normalised residuals, outliers and noise estimates."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.adjustment_result import AdjustmentResult
from compute.calibration.bundle_adjustment.gauge import gather_parameters
from compute.calibration.bundle_adjustment.normal_equations import WhitenedJacobians
from compute.camera.stack import CameraStack
from compute.robust_statistics import MAD_TO_SIGMA

Array = NDArray[np.float64]

REDUNDANCY_FLOOR = 1e-3
"""Smallest redundancy number at which a residual is tested."""


def redundancy(adjusted: AdjustmentResult, index: int = 0) -> Array:
    """Return the redundancy numbers of the readings: 1 - var(fitted) / var(reading).

    The share of a reading's error that appears in its residual, 0 to 1 (Baarda, "A testing
    procedure for use in geodetic networks", 1968).

    Args:
        adjusted: the adjustment.
        index: which of its pose sets.

    Returns:
        Shape (B, K, S); 0 where not seen.
    """
    poses = adjusted.pose_sets[index]
    cameras = CameraStack.of(adjusted.models)
    at = WhitenedJacobians.of(
        cameras, poses, np.where(poses.observed_mask, 1.0 / poses.sigma_px, 0.0)
    )
    sensors, width = cameras.parameter_index.shape
    rows = np.zeros((*poses.readings_px.shape, sensors * width))
    sensor = np.arange(sensors)[:, None]
    rows[:, :, sensor, sensor * width + np.arange(width)] = at.by_parameter
    by_sensors = gather_parameters(cameras, rows)
    count = by_sensors.shape[-1]
    by_globals = np.zeros((*poses.readings_px.shape, len(adjusted.global_covariance)))
    by_globals[..., :count] = by_sensors
    first = count + sum(p.shape.unknowns for p in adjusted.pose_sets[:index])
    by_globals[..., first : first + poses.shape.unknowns] = at.by_shape
    inverse, carried = adjusted.eliminated(index)
    by_globals -= at.by_pose @ carried[:, None]
    fitted = ((by_globals @ adjusted.global_covariance) * by_globals).sum(axis=-1)
    fitted += ((at.by_pose @ inverse[:, None]) * at.by_pose).sum(axis=-1)
    return np.where(poses.observed_mask, np.clip(1.0 - fitted, 0.0, 1.0), 0.0)


def normalised_residuals(adjusted: AdjustmentResult, index: int = 0) -> Array:
    """Return residuals over their own standard deviations.

    Args:
        adjusted: the adjustment.
        index: which of its pose sets.

    Returns:
        Shape (B, K, S); 0 where the redundancy is too small.
    """
    share = redundancy(adjusted, index)
    residual = np.nan_to_num(adjusted.residuals[index])
    return np.where(
        share > REDUNDANCY_FLOOR, residual / np.sqrt(np.maximum(share, REDUNDANCY_FLOOR)), 0.0
    )


REJECTION_LIMIT: Final = 4.5
"""Normalised residual beyond which a reading is rejected; 0.7 of 100,000 good ones exceed it."""
SIGMA_FLOOR_PX: Final = 1e-6
"""Exact data still leave rounding."""


def sensor_sigma(adjusted: AdjustmentResult, robust: bool) -> Array:
    """Estimate each sensor's noise relative to the standard deviations assumed.

    Args:
        adjusted: the adjustment.
        robust: True: from the median of the normalised residuals, which outliers hardly change.
            False: from squared residuals over their redundancy (Helmert's variance components).

    Returns:
        Ratios, shape (S,).
    """
    ratios = []
    normalised = [normalised_residuals(adjusted, i) for i in range(len(adjusted.pose_sets))]
    shares = [redundancy(adjusted, i) for i in range(len(adjusted.pose_sets))]
    for sensor in range(len(adjusted.models)):
        if robust:
            sizes = np.concatenate([np.abs(one[..., sensor]).ravel() for one in normalised])
            sizes = sizes[sizes > 0.0]
            ratios.append(MAD_TO_SIGMA * float(np.median(sizes)) if len(sizes) else 1.0)
            continue
        squares = sum(float(np.nansum(one[..., sensor] ** 2)) for one in adjusted.residuals)
        share = sum(float(one[..., sensor].sum()) for one in shares)
        ratios.append(float(np.sqrt(squares / share)) if share > 1.0 else 1.0)
    return np.array(ratios)


def worst_readings(adjusted: AdjustmentResult, index: int) -> tuple[NDArray[np.intp], Array]:
    """Return the largest outlier of each pose that has one.

    Only one for each pose, as an outlier distorts the residuals of its neighbours.

    Args:
        adjusted: the adjustment.
        index: which of its pose sets.

    Returns:
        Indices (pose, marker, sensor), shape (N, 3), and normalised residuals, shape (N,).
    """
    normalised = normalised_residuals(adjusted, index)
    flat = np.abs(normalised).reshape(len(normalised), -1)
    worst = flat.argmax(axis=1)
    beyond = np.flatnonzero(flat.max(axis=1) > REJECTION_LIMIT)
    marker_and_sensor = np.unravel_index(worst[beyond], normalised.shape[1:])
    where = np.stack([beyond, *marker_and_sensor], axis=1).astype(np.intp)
    return where, normalised[tuple(where.T)]
