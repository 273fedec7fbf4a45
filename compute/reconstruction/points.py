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
_DIAGONAL = np.arange(3)
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
    target = cameras.corrected(readings)
    with np.errstate(divide="ignore", invalid="ignore"):
        weights = 1.0 / (sigma_px * np.abs(cameras.correction_slope(readings)))
    used = np.isfinite(target) & np.isfinite(weights)
    count = used.sum(axis=1)

    start = reconstruct_linear(cameras, np.where(used, target, np.nan))
    position, rows, converged = _refine(cameras, target, np.where(used, weights, 0.0), start)
    gram = rows.transpose(0, 2, 1) @ rows
    normal, chi2 = gram[:, :3, :3], gram[:, 3, 3]

    flags = np.zeros(len(readings), dtype=np.int32)
    flags[count < 3] = PointFlag.TOO_FEW_SENSORS
    flags[(count >= 3) & ~np.isfinite(start[:, 0])] = PointFlag.DEGENERATE
    flags[np.isfinite(start[:, 0]) & ~converged] = PointFlag.NO_CONVERGENCE
    normal[flags != 0] = np.eye(3)
    spectrum = np.linalg.eigvalsh(normal)
    flags[spectrum[:, 0] <= DEGENERATE_RATIO * spectrum[:, 2]] = PointFlag.DEGENERATE
    missing = flags != 0
    normal[missing] = np.eye(3)
    covariance: Array = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    if parameter_covariance is not None:
        weighted = rows[..., :3] * np.where(used, weights, 0.0)[..., None]
        covariance = covariance + _calibration_share(
            cameras, position, weighted, covariance, parameter_covariance
        )

    limits = np.array(
        [chi2_limit(sensors - 3, INCONSISTENT_PROBABILITY) for sensors in range(len(cameras) + 1)]
    )
    flags[~missing & (count == 3)] |= PointFlag.NO_REDUNDANCY
    flags[~missing & (chi2 > limits[count])] |= PointFlag.INCONSISTENT
    position[missing], covariance[missing], chi2[missing] = np.nan, np.nan, np.nan
    return PointBatch(position, covariance, chi2, used, flags)


def _refine(
    cameras: CameraStack, target: Array, weights: Array, start: Array
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Levenberg-Marquardt for all points.

    Returns:
        Positions (N, 3), the weighted equations there (N, S, 4) and which converged (N,).
    """
    position = start.copy()
    rows = _equations(cameras, position, target, weights)
    gram = rows.transpose(0, 2, 1) @ rows
    damping = np.full(len(start), 1e-6)
    converged = np.zeros(len(start), dtype=np.bool_)
    # A start behind a lens has no residual; the point stays unconverged and is flagged.
    index = np.flatnonzero(np.isfinite(gram[:, 3, 3]))
    for _ in range(MAX_ITERATIONS):
        if len(index) == 0:
            break
        here = gram[index]
        normal = here[:, :3, :3]
        diagonal = normal[:, _DIAGONAL, _DIAGONAL]
        floor = 1e-300 + 1e-15 * diagonal.max(axis=1, keepdims=True)
        normal[:, _DIAGONAL, _DIAGONAL] += damping[index, None] * diagonal + floor
        step = np.linalg.solve(normal, here[:, :3, 3:])[..., 0]
        trial = position[index] + step
        trial_rows = _equations(cameras, trial, target[index], weights[index])
        trial_gram = trial_rows.transpose(0, 2, 1) @ trial_rows
        better = trial_gram[:, 3, 3] <= here[:, 3, 3]
        accepted = index[better]
        position[accepted] = trial[better]
        rows[accepted] = trial_rows[better]
        gram[accepted] = trial_gram[better]
        damping[index] *= np.where(better, 0.1, 10.0)
        # The next step would be shorter by the curvature over this one's length: below a
        # nanometre, far under any rounding of the result, it is not worth taking.
        small = np.abs(step).max(axis=1) <= 1e-6
        converged[index] = small
        index = index[~small & (damping[index] < 1e12)]
    return position, rows, converged


def _equations(cameras: CameraStack, position: Array, target: Array, weights: Array) -> Array:
    """Return weighted slopes and residuals side by side, shape (N, S, 4); 0 where not used."""
    projected, slope = cameras.linearised(position)
    rows = np.empty((*projected.shape, 4))
    rows[..., :3] = slope
    rows[..., 3] = target - projected
    rows *= weights[..., None]
    rows[weights == 0.0] = 0.0
    return rows


def _calibration_share(
    cameras: CameraStack, position: Array, weighted: Array, inverse: Array, covariance: Array
) -> Array:
    """Propagate the cameras' covariance to the points, shape (N, 3, 3).

    dX = -N^-1 J' W (d reading / d parameters) d parameters.
    """
    gain = inverse @ weighted.transpose(0, 2, 1)
    slopes = np.nan_to_num(cameras.parameter_jacobian(position))
    spread = (gain[..., None] * slopes[:, None]).reshape(len(position), 3, -1)
    share: Array = spread @ covariance @ spread.transpose(0, 2, 1)
    return share


@cache
def chi2_limit(freedom: int, probability: float) -> float:
    """Return the chi2 that noise exceeds with this probability; infinite without freedom."""
    return float(chdtri(freedom, probability)) if freedom > 0 else float("inf")
