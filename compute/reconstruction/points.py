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
UNINFORMATIVE_RATIO = 1e3
"""A reading this many times less certain than the third best is not used."""
DEGENERATE_RATIO = 1e-14
"""Smallest ratio of eigenvalues of the normal matrix; its root is the planes' conditioning."""


def reconstruct(
    models: Sequence[SensorModel] | CameraStack,
    readings_px: Array,
    sigma_px: Array,
    parameter_covariance: Array | None = None,
) -> PointBatch:
    """Reconstruct points from the readings of any three or more sensors.

    Minimises r' S^-1 r by Levenberg-Marquardt, from the linear solution, for all points at once:
    r are readings less projections, S their covariance, the readings' noise plus what the
    cameras' own covariance does to the projections at that place.

    Args:
        models: S calibrated cameras (or their stack, when it is used again and again).
        readings_px: shape (N, S) [px]; NaN where a sensor did not see the point.
        sigma_px: standard deviations of the readings, shape (N, S) or (S,) [px], positive.
        parameter_covariance: joint covariance of the cameras' parameters, shape (P, P), sensor by
            sensor in the order of ``SensorModel.parameter_names``. None: taken as exact.

    Returns:
        The points; those that cannot be had carry NaN and a flag that says why.
    """
    cameras = models if isinstance(models, CameraStack) else CameraStack.of(models)
    readings = np.asarray(readings_px, dtype=np.float64)
    target = cameras.corrected(readings)
    sigma = sigma_px * np.abs(cameras.correction_slope(readings))
    used = _informative(np.isfinite(target) & np.isfinite(sigma) & (sigma > 0.0), sigma)
    count = used.sum(axis=1)

    start = reconstruct_linear(cameras, np.where(used, target, np.nan))
    whitening = _whitening(cameras, start, np.where(used, sigma, 1.0), used, parameter_covariance)
    position, rows, converged = _refine(cameras, np.where(used, target, np.nan), whitening, start)
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

    limits = np.array(
        [chi2_limit(sensors - 3, INCONSISTENT_PROBABILITY) for sensors in range(len(cameras) + 1)]
    )
    flags[~missing & (count == 3)] |= PointFlag.NO_REDUNDANCY
    flags[~missing & (chi2 > limits[count])] |= PointFlag.INCONSISTENT
    position[missing], covariance[missing], chi2[missing] = np.nan, np.nan, np.nan
    return PointBatch(position, covariance, chi2, used, flags)


def _informative(seen: NDArray[np.bool_], sigma: Array) -> NDArray[np.bool_]:
    """Leave out readings that say next to nothing beside the three best, shape (N, S).

    They would count as redundancy and have none.
    """
    if seen.shape[1] < 4:
        return seen
    third = np.partition(np.where(seen, sigma, np.inf), 2, axis=1)[:, 2:3]
    return seen & (sigma <= UNINFORMATIVE_RATIO * third)


def _whitening(
    cameras: CameraStack,
    position: Array,
    sigma: Array,
    used: NDArray[np.bool_],
    parameter_covariance: Array | None,
) -> Array:
    """Return W with W S W' = 1, shape (N, S, S), for the covariance S of the used readings."""
    if parameter_covariance is None:
        return np.eye(len(cameras)) / sigma[:, :, None]
    sensors = len(cameras)
    slopes = np.nan_to_num(cameras.parameter_jacobian(position)) * used[..., None]
    blocks = cameras.spread_covariance(parameter_covariance)
    covariance: Array = np.einsum("nsp,sptq,ntq->nst", slopes, blocks, slopes)
    diagonal = np.arange(sensors)
    covariance[:, diagonal, diagonal] += sigma**2
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), dtype=np.float64)


def _refine(
    cameras: CameraStack, target: Array, whitening: Array, start: Array
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Levenberg-Marquardt for all points.

    Returns:
        Positions (N, 3), the whitened equations there (N, S, 4) and which converged (N,).
    """
    position = start.copy()
    rows = _equations(cameras, position, target, whitening)
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
        trial_rows = _equations(cameras, trial, target[index], whitening[index])
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


def _equations(cameras: CameraStack, position: Array, target: Array, whitening: Array) -> Array:
    """Return whitened slopes and residuals side by side, shape (N, S, 4); 0 where not used."""
    projected, slope = cameras.linearised(position)
    rows = np.empty((*projected.shape, 4))
    rows[..., :3] = slope
    rows[..., 3] = target - projected
    rows[np.isnan(target)] = 0.0
    whitened: Array = whitening @ rows
    return whitened


@cache
def chi2_limit(freedom: int, probability: float) -> float:
    """Return the chi2 that noise exceeds with this probability; infinite without freedom."""
    return float(chdtri(freedom, probability)) if freedom > 0 else float("inf")
