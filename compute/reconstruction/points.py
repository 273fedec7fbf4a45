"""Weighted non-linear reconstruction: points that fit the readings, with their covariance."""

from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.reconstruction.estimate import PointBatch, PointFlag
from compute.reconstruction.linear import reconstruct_linear

Array = NDArray[np.float64]

MAX_ITERATIONS = 30
INCONSISTENT_PROBABILITY = 1e-4
"""Chance that a good point is flagged as inconsistent."""
DEGENERATE_RATIO = 1e-14
"""Smallest ratio of eigenvalues of the normal matrix; its root is the planes' conditioning."""


def reconstruct(
    models: Sequence[SensorModel] | CameraStack,
    readings_px: Array,
    sigma_px: Array,
    parameter_covariance: Array | None = None,
) -> PointBatch:
    """Reconstruct points from the readings of any three or more sensors.

    Minimises the sum over sensors of ((reading - projection) / sigma)^2 by Levenberg-Marquardt,
    from the linear solution, for all points at once.

    Args:
        models: S calibrated cameras (or their stack, when it is used again and again).
        readings_px: shape (N, S) [px]; NaN where a sensor did not see the point.
        sigma_px: standard deviations of the readings, shape (N, S) or (S,) [px].
        parameter_covariance: joint covariance of the cameras' parameters, shape (7 S, 7 S); its
            share is added to each point's covariance. None: the cameras are taken as exact.

    Returns:
        The points; those that cannot be had carry NaN and a flag that says why.
    """
    cameras = models if isinstance(models, CameraStack) else CameraStack.of(models)
    readings = np.asarray(readings_px, dtype=np.float64)
    corrected = cameras.corrected(readings)
    used = np.isfinite(corrected)
    sigma = np.broadcast_to(np.asarray(sigma_px, dtype=np.float64), readings.shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        weights = 1.0 / (sigma * np.abs(cameras.correction_slope(readings)))
    weights = np.where(used & np.isfinite(weights), weights, 0.0)
    target = np.where(used, corrected, 0.0)

    flags = np.zeros(len(readings), dtype=np.int32)
    enough = used.sum(axis=1) >= 3
    flags[~enough] |= PointFlag.TOO_FEW_SENSORS
    start = reconstruct_linear(cameras, corrected)
    flags[enough & ~np.isfinite(start[:, 0])] |= PointFlag.DEGENERATE

    position, converged = _refine(cameras, target, weights, start)
    flags[np.isfinite(start[:, 0]) & ~converged] |= PointFlag.NO_CONVERGENCE

    projected, slope = cameras.linearised(position)
    jacobian = _masked(slope, used) * weights[..., None]
    residual = _masked(target - projected, used) * weights
    normal = np.einsum("nsi,nsj->nij", jacobian, jacobian)
    normal[flags != 0] = np.eye(3)
    spectrum = np.linalg.eigvalsh(normal)
    flat = (flags == 0) & (spectrum[:, 0] <= DEGENERATE_RATIO * spectrum[:, 2])
    flags[flat] |= PointFlag.DEGENERATE
    normal[flat] = np.eye(3)

    covariance = np.linalg.inv(normal)
    if parameter_covariance is not None:
        covariance = covariance + _calibration_share(
            cameras, position, jacobian * weights[..., None], covariance, parameter_covariance
        )
    chi2 = (residual**2).sum(axis=1)
    freedom = used.sum(axis=1) - 3
    limits = np.array(
        [chi2_limit(count, INCONSISTENT_PROBABILITY) for count in range(readings.shape[1] + 1)]
    )
    with np.errstate(invalid="ignore"):
        missing = flags != 0
        flags[~missing & (freedom == 0)] |= PointFlag.NO_REDUNDANCY
        loose = ~missing & (freedom > 0) & (chi2 > limits[np.maximum(freedom, 0)])
    flags[loose] |= PointFlag.INCONSISTENT
    position = np.where(missing[:, None], np.nan, position)
    covariance = np.where(missing[:, None, None], np.nan, covariance)
    return PointBatch(position, covariance, np.where(missing, np.nan, chi2), used, flags)


def _refine(
    cameras: CameraStack, target: Array, weights: Array, start: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Levenberg-Marquardt for all points; returns positions (N, 3) and which converged (N,)."""
    seen = weights > 0.0
    position = start.copy()
    damping = np.full(len(start), 1e-6)
    converged = np.zeros(len(start), dtype=np.bool_)
    projected, slope = cameras.linearised(position)
    residual = _masked(target - projected, seen) * weights
    # A start behind a lens has no residual; the point stays unconverged and is flagged.
    cost = (residual**2).sum(axis=1)
    active = np.isfinite(cost)
    for _ in range(MAX_ITERATIONS):
        index = np.flatnonzero(active)
        if len(index) == 0:
            break
        jacobian = _masked(slope[index], seen[index]) * weights[index, :, None]
        gradient = np.einsum("nsi,ns->ni", jacobian, residual[index])
        normal = np.einsum("nsi,nsj->nij", jacobian, jacobian)
        diagonal = np.einsum("nii->ni", normal)
        floor = 1e-300 + 1e-15 * diagonal.max(axis=1, keepdims=True)
        normal += np.eye(3) * (damping[index, None] * diagonal + floor)[:, None, :]
        step = np.linalg.solve(normal, gradient[..., None])[..., 0]
        trial = position[index] + step
        trial_projected, trial_slope = cameras.linearised(trial)
        trial_residual = _masked(target[index] - trial_projected, seen[index]) * weights[index]
        trial_cost = (trial_residual**2).sum(axis=1)
        better = trial_cost <= cost[index]
        # The next step would be shorter by the curvature over this one's length: below a
        # nanometre, far under any rounding of the result, it is not worth taking.
        length = np.linalg.norm(step, axis=1)
        small = length <= 1e-6
        accepted = index[better]
        position[accepted] = trial[better]
        residual[accepted] = trial_residual[better]
        slope[accepted] = trial_slope[better]
        cost[accepted] = trial_cost[better]
        damping[index] *= np.where(better, 0.1, 10.0)
        converged[index] = small
        active[index[small | (damping[index] > 1e12)]] = False
    return position, converged


def _masked(values: Array, seen: NDArray[np.bool_]) -> Array:
    """Zero the entries of sensors that did not see the point (they may be NaN)."""
    return np.where(seen if values.ndim == 2 else seen[..., None], values, 0.0)


def _calibration_share(
    cameras: CameraStack, position: Array, weighted: Array, inverse: Array, covariance: Array
) -> Array:
    """Propagate the cameras' covariance to the points, shape (N, 3, 3).

    dX = -N^-1 J' W (d reading / d parameters) d parameters.
    """
    gain = np.einsum("nij,nsj->nis", inverse, weighted)
    slopes = np.nan_to_num(cameras.parameter_jacobian(position))
    spread = np.einsum("nis,nsp->nisp", gain, slopes).reshape(len(position), 3, -1)
    share: Array = spread @ covariance @ spread.transpose(0, 2, 1)
    return share


@cache
def chi2_limit(freedom: int, probability: float) -> float:
    """Return the chi2 that noise exceeds with this probability; infinite without freedom."""
    return float(chdtri(freedom, probability)) if freedom > 0 else float("inf")
