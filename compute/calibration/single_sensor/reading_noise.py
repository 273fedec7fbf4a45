"""Noise of the readings of a device's sensors, estimated from few residuals.

The sensors of a device are alike: the logarithms of their noise scatter about the device's by one
of NOISE_SCATTERS, the device's has a prior of its own, and all of it is integrated numerically.
Many residuals override that; few leave the posterior's mean of the variance, which contains how
little they tell. The control points' uncertainty may hide the noise: the likelihood is then flat.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PRIOR_NOISE_PX: Final = 0.2
"""Median of a device's noise beforehand."""
PRIOR_LOG_SIGMA: Final = float(0.5 * np.log(6.0))
"""Standard deviation of its logarithm: with 95 % between 0.03 and 1.2 px."""
NOISE_SCATTERS: Final = (0.0, 0.4, 1.2)
"""Standard deviations of the logarithm of the sensors' noise about the device's, equally probable
beforehand."""
MIN_NOISE_PX: Final = 1e-6
"""Smallest noise: exact data still leave rounding."""
GRID_SIZE: Final = 256
GRID_MARGIN: Final = 4.0
"""Factor by which the grid of noise exceeds what single sensors and the prior's 95 % say; noise
beyond it is taken for impossible."""


@dataclass(frozen=True, eq=False)
class NoisePosterior:
    """Posterior of the sensors' noise.

    Args:
        sigma_px: roots of the posterior means of the variances, shape (S,) [px].
        geometric_px: exponentials of the posterior means of the logarithms, shape (S,) [px].
        log_evidence: logarithm of the likelihood integrated over the noise.
    """

    sigma_px: Array
    geometric_px: Array
    log_evidence: float


def estimate_noise(
    residuals_px: Array, used: NDArray[np.bool_], dof: Array, other_sigma_px: Array | None = None
) -> NoisePosterior:
    """Estimate the noise of S sensors from residuals of a fit.

    The likelihood of a variance v is that of ``dof`` independent residuals: the sum of logarithms
    of v + other_sigma_px^2 counts as dof / count of itself.

    Args:
        residuals_px: times the roots of their weights, shape (N, S) [px].
        used: which count, shape (N, S).
        dof: degrees of freedom of each sensor's residuals, shape (S,).
        other_sigma_px: standard deviations of errors beside the noise, shape (N, S) [px]; None: no
            others.
    """
    squares = np.where(used, residuals_px**2, 0.0)
    share = dof / np.maximum(used.sum(axis=0), 1)
    sensor_sigma = np.sqrt(squares.sum(axis=0) / np.maximum(dof, 1.0))
    low = (
        min(PRIOR_NOISE_PX * np.exp(-2.0 * PRIOR_LOG_SIGMA), float(sensor_sigma.min()))
        / GRID_MARGIN
    )
    high = (
        max(PRIOR_NOISE_PX * np.exp(2.0 * PRIOR_LOG_SIGMA), float(sensor_sigma.max())) * GRID_MARGIN
    )
    grid = np.linspace(np.log(max(low, MIN_NOISE_PX)), np.log(high), GRID_SIZE)
    variance = np.exp(2.0 * grid)
    likelihood = np.empty((len(dof), GRID_SIZE))
    for row in range(len(dof)):
        rows = used[:, row]
        if other_sigma_px is None:
            fit = squares[rows, row].sum() / variance
            logarithms = rows.sum() * 2.0 * grid
        else:
            total = variance + other_sigma_px[rows, row, None] ** 2
            fit = (squares[rows, row, None] / total).sum(axis=0)
            logarithms = np.log(total).sum(axis=0)
        likelihood[row] = -0.5 * (share[row] * logarithms + fit)
    return _posterior(likelihood, grid)


def _posterior(log_likelihood: Array, grid: Array) -> NoisePosterior:
    """Integrate over the device's noise, the sensors' and their scatter.

    Args:
        log_likelihood: of each sensor's noise, shape (S, V).
        grid: logarithms of the noise, equidistant, shape (V,).
    """
    step = float(grid[1] - grid[0])
    largest = log_likelihood.max(axis=1)
    likelihood = np.exp(log_likelihood - largest[:, None])
    prior = np.exp(-0.5 * ((grid - np.log(PRIOR_NOISE_PX)) / PRIOR_LOG_SIGMA) ** 2)
    log_prior = np.log(prior / prior.sum())
    log_evidence, means, logarithms = [], [], []
    for scatter in NOISE_SCATTERS:
        kernel = np.eye(len(grid))
        if scatter > 0.0:
            kernel = np.exp(-0.5 * (np.subtract.outer(grid, grid) / scatter) ** 2)
            kernel *= step / (scatter * np.sqrt(2.0 * np.pi))
        # By the device's noise, each sensor's integrated out.
        marginal = np.log(np.maximum(likelihood @ kernel, 1e-300))
        device = log_prior + marginal.sum(axis=0)
        log_evidence.append(float(np.logaddexp.reduce(device)))
        # What the prior and the other sensors say of each sensor's noise.
        others = device - marginal
        others = np.exp(others - others.max(axis=1, keepdims=True)) @ kernel
        each = others * likelihood
        each /= each.sum(axis=1, keepdims=True)
        means.append(each @ np.exp(2.0 * grid))
        logarithms.append(each @ grid)
    total = float(np.logaddexp.reduce(log_evidence))
    weight = np.exp(np.array(log_evidence) - total)
    evidence = total - float(np.log(len(NOISE_SCATTERS))) + float(largest.sum())
    return NoisePosterior(
        np.sqrt(weight @ np.array(means)), np.exp(weight @ np.array(logarithms)), evidence
    )
