"""How smooth a correction is: penalties, and what each is worth by cross-validation over blocks."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.mapping.diagonalised_basis import DiagonalisedBasis
from compute.mapping.p_splines import PenalisedFit, PenalisedProblem

Array = NDArray[np.float64]
Axes = tuple[int, int, int]

WEIGHT_STEP_RATIO = 10.0**0.5
"""Between neighbouring weights of the penalty."""
COARSE_STRIDE = 3
"""Steps between the weights that are tried at first."""
MAX_STEPS = 18
"""Steps to where the penalty weighs as the samples do; as many the other way."""
AXIS_WEIGHT_STEP_RATIO = 30.0
"""Step of the weights of the axes against one another."""
TIE_DEVIANCE_THRESHOLD = 1.0
"""Difference of twice the log density of all left-out samples that decides nothing: then the
smoother one is taken."""
REFINEMENT_DEVIANCE_THRESHOLD = 8.0
"""Such a difference from which weights between those tried do not matter."""
ABANDON_DEVIANCE_THRESHOLD = 15.0
"""Such a difference from which a search goes no further."""
IDENTICAL_FIT_DEVIANCE_THRESHOLD = 0.1
"""Such a difference below which two fits are the same one: both have no correction at all."""
MAX_ROUNDS = 3
"""Of weighing the axes anew, about the best."""
BOOTSTRAP_REPLICATES = 200
"""Of the blocks, drawn anew, by which the trials are weighed."""


@dataclass(frozen=True, eq=False)
class FittedPenalty:
    """A penalty and the fit with it.

    Args:
        weight: of the penalty [1/px^2].
        axes: weights of the axes against one another, shape (3,).
        fit: the fit.
        score: how badly left-out blocks are predicted, see ``LeftOutErrors.deviances``; a mean.
    """

    weight: float
    axes: Array
    fit: PenalisedFit
    score: float


@dataclass(frozen=True, eq=False)
class PenaltyTrial:
    """How well left-out blocks are predicted with one penalty.

    Args:
        weight, axes: as in FittedPenalty.
        deviances: of the blocks, as the variances are known or have a factor.
        scaled_deviance: their sum with the likeliest factor of all variances.
        scale: that factor.
    """

    weight: float
    axes: Array
    deviances: Array
    scaled_deviance: float
    scale: float

    @property
    def total(self) -> float:
        """Minus twice the log density of all left-out blocks, but for a constant."""
        return float(self.deviances.sum())


@dataclass(frozen=True, eq=False)
class PenaltyPosterior:
    """Penalties that were tried.

    Args:
        trials: all of them.
        best: index of the one by which blocks are predicted best.
        probabilities: probabilities of the trials, shape (K,).
    """

    trials: tuple[PenaltyTrial, ...]
    best: int
    probabilities: Array

    def contradicts_variances(self, limit: float) -> bool:
        """Tell whether left-out blocks want larger variances by more than ``limit``.

        Twice the difference of log densities, of one factor of all variances against none. The
        residuals need not show it: a fit that takes noise for the field's leaves none.
        """
        likeliest = min(self.trials, key=lambda trial: trial.scaled_deviance)
        least = min(trial.total for trial in self.trials)
        return likeliest.scale > 1.0 and least - likeliest.scaled_deviance > limit


def fit_penalty(
    problem: PenalisedProblem, functions: DiagonalisedBasis, weight: float, axes: Array
) -> FittedPenalty:
    """Fit with a given penalty."""
    fit = problem.solve(weight * functions.penalty(axes))
    deviances = fit.left_out().deviances(known_variance=problem.known_variance)
    return FittedPenalty(weight, axes, fit, float(deviances.sum()) / len(problem.samples))


def evaluate_penalty(
    problem: PenalisedProblem, functions: DiagonalisedBasis, weight: float, axes: Array
) -> PenaltyTrial:
    """Try a given penalty."""
    left_out = problem.solve(weight * functions.penalty(axes)).left_out()
    scaled_deviance = left_out.deviances(known_variance=False)
    known = left_out.deviances(known_variance=True) if problem.known_variance else scaled_deviance
    return PenaltyTrial(weight, axes, known, float(scaled_deviance.sum()), left_out.scale**2)


def single_penalty(
    problem: PenalisedProblem, functions: DiagonalisedBasis, weight: float
) -> PenaltyPosterior:
    """Return a penalty that is held for known."""
    return PenaltyPosterior(
        (evaluate_penalty(problem, functions, weight, np.ones(3)),), 0, np.ones(1)
    )


def cross_validate_penalties(
    problem: PenalisedProblem,
    functions: DiagonalisedBasis,
    on_trial: Callable[[], None] = lambda: None,
) -> PenaltyPosterior:
    """Return penalties and how probable each is by the blocks that it leaves out.

    By the density that the fit without a block gives its samples, so that the variances count as
    the errors do (S. Sundararajan and S. S. Keerthi, 2001, doi:10.1162/08997660151134343). Blocks
    and not single points: neighbours share what is wrong with both, and a fit that follows it
    would be thought good.

    The weights lie on a lattice, the axes' against one another, too, as corrections change less
    along the depth than across it: all weights with equal axes, then those about the best with
    one axis' weight raised or lowered, and again about the best of these.

    Args:
        problem: the samples.
        functions: the penalised functions, as many as the problem says.
        on_trial: called after each trial.
    """
    penalty_grid = _PenaltyGrid(problem, functions, on_trial)
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
    # Of all that have no correction, one is enough.
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
    # That the axes differ by more than a step is not likely before anything is measured.
    unlike = np.exp(-0.5 * np.sum([np.square(axes) for _, axes in retained], axis=1))
    return PenaltyPosterior(
        trials,
        retained.index(best),
        _posterior_probabilities(trials, step_widths(retained) * unlike),
    )


class _PenaltyGrid:
    """Trials by their place: steps of the weight, and of the axes' weights."""

    def __init__(
        self, problem: PenalisedProblem, functions: DiagonalisedBasis, on_trial: Callable[[], None]
    ) -> None:
        self.evaluated: dict[tuple[int, Axes], PenaltyTrial] = {}
        self._problem, self._functions, self._on_trial = problem, functions, on_trial
        samples = np.diag(problem.gram)[: len(functions)].mean()
        self._balanced_weight = float(samples / np.median(functions.penalty(np.ones(3))))

    def trial(self, step: int, axes: Axes) -> PenaltyTrial:
        """Return the trial at a place."""
        node = (step, axes)
        if node not in self.evaluated:
            self.evaluated[node] = evaluate_penalty(
                self._problem,
                self._functions,
                self._balanced_weight * WEIGHT_STEP_RATIO**step,
                AXIS_WEIGHT_STEP_RATIO ** np.array(axes, dtype=np.float64),
            )
            self._on_trial()
        return self.evaluated[node]

    def null_penalty(self) -> tuple[int, Axes]:
        """Try all weights with equal axes; return the place of the least that corrects nothing."""
        equal = (0, 0, 0)
        steps = range(MAX_STEPS, -MAX_STEPS - 1, -COARSE_STRIDE)
        totals = [self.trial(step, equal) for step in steps]
        last = 0
        while (
            last + 1 < len(totals)
            and np.abs(totals[last + 1].deviances - totals[0].deviances).sum()
            < IDENTICAL_FIT_DEVIANCE_THRESHOLD
        ):
            last += 1
        return steps[last], equal

    def best(self, axes: Axes | None = None) -> tuple[int, Axes]:
        """Return the place of the smoothest of those that do as well as any."""
        least = min(trial.total for trial in self.evaluated.values())
        return max(
            (
                node
                for node, trial in self.evaluated.items()
                if trial.total <= least + TIE_DEVIANCE_THRESHOLD and axes in (None, node[1])
            ),
            key=lambda node: (
                self.evaluated[node].weight * self.evaluated[node].axes.prod() ** (1 / 3)
            ),
        )

    def refine(self, axes: Axes) -> None:
        """Try the weights between on a line that counts: the lattice may be wide for its peak."""
        totals = {
            step: trial.total for (step, same), trial in self.evaluated.items() if same == axes
        }
        step = min(totals, key=lambda step: (totals[step], -step))
        if (
            totals[step]
            <= min(trial.total for trial in self.evaluated.values()) + REFINEMENT_DEVIANCE_THRESHOLD
        ):
            self.search_line(axes, step, 1, COARSE_STRIDE - 1)

    def search_line(self, axes: Axes, start: int, stride: int, reach: int = 2 * MAX_STEPS) -> None:
        """Try weights up and down from a place as long as one may be found that counts."""
        for way in (stride, -stride):
            step, before = start, np.inf
            while abs(step) <= MAX_STEPS:
                here = self.trial(step, axes).total
                least = min(trial.total for trial in self.evaluated.values())
                if (
                    here > min(least + ABANDON_DEVIANCE_THRESHOLD, before)
                    or abs(step - start) > reach
                ):
                    break
                step, before = step + way, max(here, least + ABANDON_DEVIANCE_THRESHOLD)


def step_widths(nodes: list[tuple[int, Axes]]) -> Array:
    """Return how much of its axes' line each place stands for, in steps."""
    widths = np.empty(len(nodes))
    for number, (step, axes) in enumerate(nodes):
        others = [other for other, same in nodes if same == axes and other != step]
        above = min((other - step for other in others if other > step), default=COARSE_STRIDE)
        below = min((step - other for other in others if other < step), default=COARSE_STRIDE)
        widths[number] = 0.5 * (min(above, COARSE_STRIDE) + min(below, COARSE_STRIDE))
    return widths


def _posterior_probabilities(trials: tuple[PenaltyTrial, ...], prior: Array) -> Array:
    """Return the trials' probabilities, shape (K,), from those before the data, up to a factor.

    Weights by the density of left-out data are too sure of themselves, as another sample would
    have had others: their mean over Bayesian bootstrap replicates of the blocks is taken
    ("pseudo-BMA+"; Y. Yao, A. Vehtari, D. Simpson, A. Gelman, 2018, doi:10.1214/17-BA1091). The
    replicates are the same whenever the number of blocks is.
    """
    deviances = np.stack([trial.deviances for trial in trials])
    blocks = deviances.shape[1]
    drawn = np.random.default_rng(blocks).dirichlet(np.ones(blocks), BOOTSTRAP_REPLICATES) * blocks
    logs = -0.5 * deviances @ drawn.T + np.log(prior)[:, None]
    each = np.exp(logs - logs.max(axis=0))
    probabilities: Array = (each / each.sum(axis=0)).mean(axis=1)
    return probabilities


def gcv_score(fit: PenalisedFit) -> float:
    """Return the generalised cross-validation score, a mean squared whitened error.

    P. Craven and G. Wahba, 1978, doi:10.1007/BF01404567.
    """
    count = fit.problem.count
    dof = max(count - fit.effective_parameters, 1.0)
    return count * fit.residual_sum_of_squares / dof**2
