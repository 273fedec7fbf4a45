"""AveragedFit: penalised fits averaged over penalties by their probabilities."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.mapping.diagonalised_basis import DiagonalisedBasis
from compute.mapping.p_splines import PenalisedFit, PenalisedProblem
from compute.mapping.penalty_selection import PenaltyPosterior

Array = NDArray[np.float64]

MIN_SHARE = 1e-3
"""Probability relative to the best below which a penalty is left out."""


@dataclass(frozen=True, eq=False)
class AveragedFit:
    """Mean and covariance of a mixture of posterior distributions over penalties.

    The covariance is the mean of the fits' own plus that of their means: the right penalty is
    unknown, and with noise as large as the correction the fits differ by as much as each is
    uncertain.

    Args:
        amounts: coefficients of the functions, shape (R + Q,).
        covariance: shape (R + Q, R + Q).
        error: of samples in left-out blocks, whitened, shape (T,).
        sigma: the standard deviations expected of them, shape (T,).
        effective_parameters: the mean.
        factor: mean factor of the samples' variances that the fits show; included in the
            covariance and ``sigma``.
    """

    amounts: Array
    covariance: Array
    error: Array
    sigma: Array
    effective_parameters: float
    factor: float

    def variance(self, functions: Array) -> Array:
        """Return the variances of linear combinations with rows (n, R + Q), shape (n,)."""
        variance: Array = ((functions @ self.covariance) * functions).sum(axis=1)
        return np.maximum(variance, 0.0)


def average(
    problem: PenalisedProblem,
    functions: DiagonalisedBasis,
    penalties: PenaltyPosterior,
    factor: Callable[[PenalisedFit], float],
) -> AveragedFit:
    """Fit with all penalties of relevant probability and average.

    Args:
        problem: the samples.
        functions: the penalised functions.
        penalties: the penalties with their probabilities.
        factor: returns the factor of the samples' variances that a fit shows.
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
        variance_factor = factor(fit)
        covariance += share * variance_factor * fit.covariance()
        variance += share * variance_factor * left_out.sigma**2
        amounts.append(fit.amounts)
        errors.append(left_out.error)
        parameters.append(fit.effective_parameters)
        factors.append(variance_factor)
    mean, error = probabilities @ np.stack(amounts), probabilities @ np.stack(errors)
    between = np.sqrt(probabilities)[:, None] * (np.stack(amounts) - mean)
    covariance += between.T @ between
    variance += probabilities @ (np.stack(errors) - error) ** 2
    return AveragedFit(
        mean,
        covariance,
        error,
        np.sqrt(variance),
        float(probabilities @ parameters),
        float(np.clip(probabilities @ factors, min(factors), max(factors))),  # exactly 1 of ones
    )
