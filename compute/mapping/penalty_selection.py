"""Penalties with their probabilities by cross-validation over blocks; average of their fits."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.mapping.diagonalised_basis import DiagonalisedBasis
from compute.mapping.p_splines import PenalisedFit, PenalisedProblem
from compute.mapping.penalty_grid import (
    COARSE_STRIDE,
    IDENTICAL_FIT_DEVIANCE_THRESHOLD,
    PenaltyGrid,
    PenaltyTrial,
    step_widths,
)

Array = NDArray[np.float64]

MAX_ROUNDS = 3
"""Largest number of rounds of searching the axes' weights about the best."""
BOOTSTRAP_REPLICATES = 200
"""Bayesian bootstrap replicates of the blocks for the probabilities of penalties."""
MIN_SHARE = 1e-3
"""Probability relative to the best below which a penalty is left out."""


@dataclass(frozen=True, eq=False)
class PenaltyPosterior:
    """Penalties with their probabilities.

    Args:
        trials: the K penalties.
        best: index of the one that predicts blocks best.
        probabilities: of the penalties, shape (K,).
    """

    trials: tuple[PenaltyTrial, ...]
    best: int
    probabilities: Array

    def contradicts_variances(self, limit: float) -> bool:
        """Return whether left-out blocks demand larger variances.

        Tests twice the log likelihood ratio of a common factor of all variances against ``limit``.
        The residuals need not show it: a fit that follows the noise leaves none.
        """
        most_probable = min(self.trials, key=lambda trial: trial.scaled_deviance)
        least = min(trial.total for trial in self.trials)
        return most_probable.scale > 1.0 and least - most_probable.scaled_deviance > limit


def cross_validate_penalties(
    problem: PenalisedProblem,
    functions: DiagonalisedBasis,
    on_trial: Callable[[], None] = lambda: None,
) -> PenaltyPosterior:
    """Return penalties with their probabilities by cross-validation over blocks.

    The score is the predictive density of left-out blocks, which tests variances as well as errors
    (S. Sundararajan and S. S. Keerthi, 2001, doi:10.1162/08997660151134343). Blocks, not single
    points: errors of neighbours are correlated, and a fit that follows them would score too well.

    The weights lie on a grid, the axes' relative weights included, as corrections vary less along
    the depth than across it: first all weights with equal axes, then those about the best with one
    axis' weight raised or lowered, and again about the best of these.

    Args:
        problem: the samples.
        functions: the penalised functions of the problem.
        on_trial: called after each trial.
    """
    penalty_grid = PenaltyGrid(problem, functions, on_trial)
    none = penalty_grid.null_penalty()
    best = penalty_grid.best((0, 0, 0))
    for _ in range(MAX_ROUNDS):
        previous = best
        for axis in range(3):
            for sign in (1, -1):
                raised = list(previous[1])
                raised[axis] += sign
                penalty_grid.search_line(
                    (raised[0], raised[1], raised[2]), previous[0], COARSE_STRIDE
                )
        best = penalty_grid.best()
        if best[1] == previous[1]:
            break
    for axes in sorted({node[1] for node in penalty_grid.evaluated}):
        penalty_grid.refine(axes)
    best = penalty_grid.best()
    # Keep one of all penalties that leave no correction.
    retained = [
        node
        for node, trial in penalty_grid.evaluated.items()
        if node == none
        or np.abs(trial.deviances - penalty_grid.evaluated[none].deviances).sum()
        > IDENTICAL_FIT_DEVIANCE_THRESHOLD
    ]
    if best not in retained:
        best = none
    trials = tuple(penalty_grid.evaluated[node] for node in retained)
    # Prior: axes hardly differ by more than a step.
    axes_prior = np.exp(-0.5 * np.sum([np.square(axes) for _, axes in retained], axis=1))
    return PenaltyPosterior(
        trials,
        retained.index(best),
        _posterior_probabilities(trials, step_widths(retained) * axes_prior),
    )


def _posterior_probabilities(trials: tuple[PenaltyTrial, ...], prior: Array) -> Array:
    """Return the trials' posterior probabilities, shape (K,), from unnormalised priors.

    Weights by the density of left-out data are overconfident, as another sample would have given
    others: their mean over Bayesian bootstrap replicates of the blocks is taken
    ("pseudo-BMA+"; Y. Yao, A. Vehtari, D. Simpson, A. Gelman, 2018, doi:10.1214/17-BA1091). The
    replicates depend on the number of blocks only.
    """
    deviances = np.stack([trial.deviances for trial in trials])
    blocks = deviances.shape[1]
    drawn = np.random.default_rng(blocks).dirichlet(np.ones(blocks), BOOTSTRAP_REPLICATES) * blocks
    logs = -0.5 * deviances @ drawn.T + np.log(prior)[:, None]
    each = np.exp(logs - logs.max(axis=0))
    return np.asarray((each / each.sum(axis=0)).mean(axis=1))


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
        fit = trial.fit(problem, functions)
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


def gcv_score(fit: PenalisedFit) -> float:
    """Return the generalised cross-validation score, a mean squared whitened error.

    P. Craven and G. Wahba, 1978, doi:10.1007/BF01404567.
    """
    count = fit.problem.count
    dof = max(count - fit.effective_parameters, 1.0)
    return count * fit.residual_sum_of_squares / dof**2
