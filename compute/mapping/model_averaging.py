"""AveragedFit: penalised fits with several penalties, each as far as it is probable."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.mapping.diagonalised_basis import DiagonalisedBasis
from compute.mapping.p_splines import PenalisedFit, PenalisedProblem
from compute.mapping.penalty_selection import PenaltyPosterior

Array = NDArray[np.float64]

MIN_SHARE = 1e-3
"""Of a penalty, below which it is left away."""


@dataclass(frozen=True, eq=False)
class AveragedFit:
    """The mixture of the fits' posterior distributions, by its mean and covariance.

    The covariance is the mean of the fits' own and that of their means: which penalty is right is
    not known, and with noise as large as what is to be corrected the fits differ by as much as
    each is uncertain.

    Args:
        amounts: of the functions, shape (R + Q,).
        covariance: shape (R + Q, R + Q).
        error: of samples in blocks that the fits did not see, whitened, shape (T,).
        sigma: the standard deviations that they should have, shape (T,).
        effective_parameters: the mean.
        factor: by what the variances of all samples are to be multiplied, as the fits show; the
            mean. It is in covariance and deviation.
    """

    amounts: Array
    covariance: Array
    error: Array
    sigma: Array
    effective_parameters: float
    factor: float

    def variance(self, functions: Array) -> Array:
        """Return the variances of sums with rows of functions (n, R + Q), shape (n,)."""
        variance: Array = ((functions @ self.covariance) * functions).sum(axis=1)
        return np.maximum(variance, 0.0)


def average(
    problem: PenalisedProblem,
    functions: DiagonalisedBasis,
    penalties: PenaltyPosterior,
    factor: Callable[[PenalisedFit], float],
) -> AveragedFit:
    """Fit with all penalties that count, and average.

    Args:
        problem: the samples.
        functions: the penalised functions.
        penalties: how probable each is.
        factor: of the samples' variances, as a fit shows.
    """
    counted = np.flatnonzero(penalties.probabilities >= MIN_SHARE * penalties.probabilities.max())
    probabilities = penalties.probabilities[counted] / penalties.probabilities[counted].sum()
    amounts, errors = [], []
    covariance = np.zeros_like(problem.gram)
    variance = np.zeros_like(problem.samples)
    parameters, factors = [], []
    for share, number in zip(probabilities, counted, strict=True):
        trial = penalties.trials[number]
        fit = problem.solve(trial.weight * functions.penalty(trial.axes))
        left_out = fit.left_out()
        own = factor(fit)
        covariance += share * own * fit.covariance()
        variance += share * own * left_out.sigma**2
        amounts.append(fit.amounts)
        errors.append(left_out.error)
        parameters.append(fit.effective_parameters)
        factors.append(own)
    mean, error = probabilities @ np.stack(amounts), probabilities @ np.stack(errors)
    apart = np.sqrt(probabilities)[:, None] * (np.stack(amounts) - mean)
    covariance += apart.T @ apart
    variance += probabilities @ (np.stack(errors) - error) ** 2
    return AveragedFit(
        mean,
        covariance,
        error,
        np.sqrt(variance),
        float(probabilities @ parameters),
        float(np.clip(probabilities @ factors, min(factors), max(factors))),  # exactly 1 of ones
    )
