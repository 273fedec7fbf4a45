"""How smooth a correction is: penalties, and what each is worth by cross-validation over blocks."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.mapping.penalised import PenalisedFit, PenalisedProblem
from compute.mapping.smooth_basis import SmoothBasis

Array = NDArray[np.float64]
Axes = tuple[int, int, int]

STEP = 10.0**0.5
"""Between neighbouring weights of the penalty."""
STRIDE = 3
"""Steps between the weights that are tried at first."""
SMOOTHEST = 18
"""Steps to where the penalty weighs as the samples do; as many the other way."""
AXIS_RATIO = 30.0
"""Step of the weights of the axes against one another."""
TIE = 1.0
"""Difference of twice the log density of all left-out samples that decides nothing: then the
smoother one is taken."""
COUNTED = 8.0
"""Such a difference from which weights between those tried do not matter."""
HOPELESS = 15.0
"""Such a difference from which a search goes no further."""
ALIKE = 0.1
"""Such a difference below which two fits are the same one: both have no correction at all."""
ROUNDS = 3
"""Of weighing the axes anew, about the best."""
REPLICATES = 200
"""Of the blocks, drawn anew, by which the trials are weighed."""


@dataclass(frozen=True, eq=False)
class Smoothness:
    """A penalty and the fit with it.

    Args:
        weight: of the penalty [1/px^2].
        axes: weights of the axes against one another, shape (3,).
        fit: the fit.
        score: how badly left-out blocks are predicted, see ``LeftOut.surprises``; a mean.
    """

    weight: float
    axes: Array
    fit: PenalisedFit
    score: float


@dataclass(frozen=True, eq=False)
class Trial:
    """How well left-out blocks are predicted with one penalty.

    Args:
        weight, axes: as in Smoothness.
        surprises: of the blocks, as the variances are known or have a factor.
        scaled: their sum with the likeliest factor of all variances.
        scale: that factor.
    """

    weight: float
    axes: Array
    surprises: Array
    scaled: float
    scale: float

    @property
    def total(self) -> float:
        """Minus twice the log density of all left-out blocks, but for a constant."""
        return float(self.surprises.sum())


@dataclass(frozen=True, eq=False)
class Penalties:
    """Penalties that were tried.

    Args:
        trials: all of them.
        best: index of the one by which blocks are predicted best.
        shares: probabilities of the trials, shape (K,).
    """

    trials: tuple[Trial, ...]
    best: int
    shares: Array

    def contradict(self, limit: float) -> bool:
        """Tell whether left-out blocks want larger variances by more than ``limit``.

        Twice the difference of log densities, of one factor of all variances against none. The
        residuals need not show it: a fit that takes noise for the field's leaves none.
        """
        likeliest = min(self.trials, key=lambda trial: trial.scaled)
        least = min(trial.total for trial in self.trials)
        return likeliest.scale > 1.0 and least - likeliest.scaled > limit


def fit_with(
    problem: PenalisedProblem, functions: SmoothBasis, weight: float, axes: Array
) -> Smoothness:
    """Fit with a given penalty."""
    fit = problem.solve(weight * functions.penalty(axes))
    surprises = fit.left_out().surprises(known_variance=problem.known_variance)
    return Smoothness(weight, axes, fit, float(surprises.sum()) / len(problem.samples))


def try_penalty(
    problem: PenalisedProblem, functions: SmoothBasis, weight: float, axes: Array
) -> Trial:
    """Try a given penalty."""
    left_out = problem.solve(weight * functions.penalty(axes)).left_out()
    scaled = left_out.surprises(known_variance=False)
    known = left_out.surprises(known_variance=True) if problem.known_variance else scaled
    return Trial(weight, axes, known, float(scaled.sum()), left_out.scale**2)


def single_penalty(problem: PenalisedProblem, functions: SmoothBasis, weight: float) -> Penalties:
    """Return a penalty that is held for known."""
    return Penalties((try_penalty(problem, functions, weight, np.ones(3)),), 0, np.ones(1))


def weigh_penalties(
    problem: PenalisedProblem, functions: SmoothBasis, told: Callable[[], None] = lambda: None
) -> Penalties:
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
        told: called after each trial.
    """
    lattice = _Lattice(problem, functions, told)
    none = lattice.smoothest()
    best = lattice.best((0, 0, 0))
    for _ in range(ROUNDS):
        middle = best
        for axis in range(3):
            for sign in (1, -1):
                raised = list(middle[1])
                raised[axis] += sign
                lattice.walk((raised[0], raised[1], raised[2]), middle[0], STRIDE)
        best = lattice.best()
        if best[1] == middle[1]:
            break
    for axes in sorted({place[1] for place in lattice.tried}):
        lattice.refine(axes)
    best = lattice.best()
    # Of all that have no correction, one is enough.
    kept = [
        place
        for place, trial in lattice.tried.items()
        if place == none or np.abs(trial.surprises - lattice.tried[none].surprises).sum() > ALIKE
    ]
    if best not in kept:
        best = none
    trials = tuple(lattice.tried[place] for place in kept)
    # That the axes differ by more than a step is not likely before anything is measured.
    unlike = np.exp(-0.5 * np.sum([np.square(axes) for _, axes in kept], axis=1))
    return Penalties(trials, kept.index(best), _shares(trials, line_widths(kept) * unlike))


class _Lattice:
    """Trials by their place: steps of the weight, and of the axes' weights."""

    def __init__(
        self, problem: PenalisedProblem, functions: SmoothBasis, told: Callable[[], None]
    ) -> None:
        self.tried: dict[tuple[int, Axes], Trial] = {}
        self._problem, self._functions, self._told = problem, functions, told
        samples = np.diag(problem.gram)[: len(functions)].mean()
        self._middle = float(samples / np.median(functions.penalty(np.ones(3))))

    def trial(self, step: int, axes: Axes) -> Trial:
        """Return the trial at a place."""
        place = (step, axes)
        if place not in self.tried:
            self.tried[place] = try_penalty(
                self._problem,
                self._functions,
                self._middle * STEP**step,
                AXIS_RATIO ** np.array(axes, dtype=np.float64),
            )
            self._told()
        return self.tried[place]

    def smoothest(self) -> tuple[int, Axes]:
        """Try all weights with equal axes; return the place of the least that corrects nothing."""
        equal = (0, 0, 0)
        steps = range(SMOOTHEST, -SMOOTHEST - 1, -STRIDE)
        totals = [self.trial(step, equal) for step in steps]
        last = 0
        while (
            last + 1 < len(totals)
            and np.abs(totals[last + 1].surprises - totals[0].surprises).sum() < ALIKE
        ):
            last += 1
        return steps[last], equal

    def best(self, axes: Axes | None = None) -> tuple[int, Axes]:
        """Return the place of the smoothest of those that do as well as any."""
        least = min(trial.total for trial in self.tried.values())
        return max(
            (
                place
                for place, trial in self.tried.items()
                if trial.total <= least + TIE and axes in (None, place[1])
            ),
            key=lambda place: self.tried[place].weight * self.tried[place].axes.prod() ** (1 / 3),
        )

    def refine(self, axes: Axes) -> None:
        """Try the weights between on a line that counts: the lattice may be wide for its peak."""
        totals = {step: trial.total for (step, same), trial in self.tried.items() if same == axes}
        step = min(totals, key=lambda step: (totals[step], -step))
        if totals[step] <= min(trial.total for trial in self.tried.values()) + COUNTED:
            self.walk(axes, step, 1, STRIDE - 1)

    def walk(self, axes: Axes, start: int, stride: int, reach: int = 2 * SMOOTHEST) -> None:
        """Try weights up and down from a place as long as one may be found that counts."""
        for way in (stride, -stride):
            step, before = start, np.inf
            while abs(step) <= SMOOTHEST:
                here = self.trial(step, axes).total
                least = min(trial.total for trial in self.tried.values())
                if here > min(least + HOPELESS, before) or abs(step - start) > reach:
                    break
                step, before = step + way, max(here, least + HOPELESS)


def line_widths(places: list[tuple[int, Axes]]) -> Array:
    """Return how much of its axes' line each place stands for, in steps."""
    widths = np.empty(len(places))
    for number, (step, axes) in enumerate(places):
        others = [other for other, same in places if same == axes and other != step]
        above = min((other - step for other in others if other > step), default=STRIDE)
        below = min((step - other for other in others if other < step), default=STRIDE)
        widths[number] = 0.5 * (min(above, STRIDE) + min(below, STRIDE))
    return widths


def _shares(trials: tuple[Trial, ...], prior: Array) -> Array:
    """Return the trials' probabilities, shape (K,), from those before the data, up to a factor.

    Weights by the density of left-out data are too sure of themselves, as another sample would
    have had others: their mean over Bayesian bootstrap replicates of the blocks is taken
    ("pseudo-BMA+"; Y. Yao, A. Vehtari, D. Simpson, A. Gelman, 2018, doi:10.1214/17-BA1091). The
    replicates are the same whenever the number of blocks is.
    """
    surprises = np.stack([trial.surprises for trial in trials])
    blocks = surprises.shape[1]
    drawn = np.random.default_rng(blocks).dirichlet(np.ones(blocks), REPLICATES) * blocks
    logs = -0.5 * surprises @ drawn.T + np.log(prior)[:, None]
    each = np.exp(logs - logs.max(axis=0))
    shares: Array = (each / each.sum(axis=0)).mean(axis=1)
    return shares


def gcv_score(fit: PenalisedFit) -> float:
    """Return the generalised cross-validation score, a mean squared whitened error.

    P. Craven and G. Wahba, 1978, doi:10.1007/BF01404567.
    """
    count = fit.problem.count
    freedom = max(count - fit.effective_parameters, 1.0)
    return count * fit.residual_square / freedom**2
