"""How smooth a correction is, by cross-validation over blocks."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.mapping.penalised import PenalisedFit, PenalisedProblem
from compute.mapping.smooth_basis import SmoothBasis

Array = NDArray[np.float64]

DECADES = np.arange(9.0, -9.1, -1.5)
"""Of the penalty's weight that are tried, from where it weighs as the samples."""
AXIS_RATIO = 30.0
"""Step of the weights of the axes against one another."""
TIE = 1.0
"""Difference of twice the log density of all left-out samples that decides nothing: then the
smoother one is taken."""
_STEPS = 3


@dataclass(frozen=True, eq=False)
class Smoothness:
    """A penalty and the fit with it.

    Args:
        weight: of the penalty [1/px^2].
        axes: weights of the axes against one another, shape (3,).
        fit: the fit.
        score: how badly left-out blocks are predicted, see ``LeftOut.surprise``.
    """

    weight: float
    axes: Array
    fit: PenalisedFit
    score: float


def fit_with(
    problem: PenalisedProblem, functions: SmoothBasis, weight: float, axes: Array
) -> Smoothness:
    """Fit with a given penalty."""
    fit = problem.solve(weight * functions.penalty(axes))
    score = fit.left_out().surprise(known_variance=problem.known_variance)
    return Smoothness(weight, axes, fit, score)


def choose_smoothness(
    problem: PenalisedProblem, functions: SmoothBasis, told: Callable[[], None] = lambda: None
) -> Smoothness:
    """Return the penalty with which left-out blocks are predicted best.

    Best by the density that the fit without a block gives its samples, so that the variances count
    as the errors do (S. Sundararajan and S. S. Keerthi, 2001, doi:10.1162/08997660151134343).
    Blocks and not single points: neighbours share what is wrong with both, and a fit that follows
    it would be thought good. The weight is searched over decades and then between them; the axes'
    weights one after the other, as corrections change less along the depth than across it.

    Args:
        problem: the samples.
        functions: the penalised functions, as many as the problem says.
        told: called after each trial.
    """

    def trial(weight: float, axes: Array) -> Smoothness:
        told()
        return fit_with(problem, functions, weight, axes)

    def walked(start: Smoothness, step: float) -> Smoothness:
        """Walk the weight up or down by a factor as long as it gets better."""
        best = start
        for factor in (step, 1.0 / step):
            for _ in range(_STEPS):
                other = trial(best.weight * factor, best.axes)
                if other.score >= best.score - tie:
                    break
                best = other
        return best

    tie = TIE / len(problem.samples)
    equal = np.ones(3)
    samples = np.diag(problem.gram)[: len(functions)].mean()
    middle = float(samples / np.median(functions.penalty(equal)))
    tried = [trial(middle * 10.0**decade, equal) for decade in DECADES]
    least = min(one.score for one in tried)
    # The smoothest of those that do as well.
    best = next(one for one in tried if one.score <= least + tie)
    if best is tried[0]:
        return best  # no correction at all: there is nothing that could have a direction
    for axis in range(3):
        for ratio in (AXIS_RATIO, 1.0 / AXIS_RATIO):
            axes = best.axes.copy()
            axes[axis] *= ratio
            other = walked(trial(best.weight, axes), AXIS_RATIO**0.5)
            if other.score < best.score - tie:
                best = other
                break
    return walked(best, 2.0)


def gcv_score(fit: PenalisedFit) -> float:
    """Return the generalised cross-validation score, a mean squared whitened error.

    P. Craven and G. Wahba, 1978, doi:10.1007/BF01404567.
    """
    count = fit.problem.count
    freedom = max(count - fit.effective_parameters, 1.0)
    return count * fit.residual_square / freedom**2
