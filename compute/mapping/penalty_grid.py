"""Grid of penalties with their cross-validation trials, and the search over it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.mapping.diagonalised_basis import DiagonalisedBasis
from compute.mapping.p_splines import PenalisedFit, PenalisedProblem

Array = NDArray[np.float64]
Axes = tuple[int, int, int]

WEIGHT_STEP_RATIO = 10.0**0.5
"""Ratio of neighbouring weights of the penalty."""
COARSE_STRIDE = 3
"""Steps between the weights of the first, coarse search."""
MAX_STEPS = 18
"""Largest number of steps either way from the weight at which penalty and samples balance."""
AXIS_WEIGHT_STEP_RATIO = 30.0
"""Ratio of neighbouring relative weights of an axis."""
TIE_DEVIANCE_THRESHOLD = 1.0
"""Insignificant difference of the deviance of all left-out samples: the smoother fit is taken."""
REFINEMENT_DEVIANCE_THRESHOLD = 8.0
"""Difference from the best from which a line is not refined."""
ABANDON_DEVIANCE_THRESHOLD = 15.0
"""Difference from the best at which a line search ends."""
IDENTICAL_FIT_DEVIANCE_THRESHOLD = 0.1
"""Difference below which two fits are identical: neither has any correction."""


@dataclass(frozen=True, eq=False)
class PenaltyTrial:
    """Cross-validation of one penalty.

    Args:
        weight: weight of the penalty [1/px^2].
        axes: relative weights of the axes, shape (3,).
        deviances: of the blocks, with known variances or their factor, shape (B,).
        scaled_deviance: their sum with the maximum-likelihood factor of all variances.
        scale: that factor.
    """

    weight: float
    axes: Array
    deviances: Array
    scaled_deviance: float
    scale: float

    @property
    def total(self) -> float:
        """Minus twice the log density of all left-out blocks, up to a constant."""
        return float(self.deviances.sum())

    def fit(self, problem: PenalisedProblem, functions: DiagonalisedBasis) -> PenalisedFit:
        """Fit samples with this penalty.

        Args:
            problem: the samples.
            functions: the penalised functions.
        """
        return problem.solve(self.weight * functions.penalty(self.axes))


def evaluate_penalty(
    problem: PenalisedProblem, functions: DiagonalisedBasis, weight: float, axes: Array
) -> PenaltyTrial:
    """Cross-validate a given penalty.

    Args:
        problem: the samples.
        functions: the penalised functions.
        weight: weight of the penalty [1/px^2].
        axes: relative weights of the axes, shape (3,).
    """
    left_out = problem.solve(weight * functions.penalty(axes)).left_out()
    scaled_deviance = left_out.deviances(known_variance=False)
    known = left_out.deviances(known_variance=True) if problem.known_variance else scaled_deviance
    return PenaltyTrial(weight, axes, known, float(scaled_deviance.sum()), left_out.scale**2)


class PenaltyGrid:
    """Trials on a grid: steps of the weight and of the relative weights of the axes."""

    def __init__(
        self, problem: PenalisedProblem, functions: DiagonalisedBasis, on_trial: Callable[[], None]
    ) -> None:
        self.evaluated: dict[tuple[int, Axes], PenaltyTrial] = {}
        self._problem, self._functions, self._on_trial = problem, functions, on_trial
        samples = np.diag(problem.gram)[: len(functions)].mean()
        self._balanced_weight = float(samples / np.median(functions.penalty(np.ones(3))))

    def trial(self, step: int, axes: Axes) -> PenaltyTrial:
        """Return the trial at a grid node.

        Args:
            step: steps of the weight from the balanced one.
            axes: steps of the relative weights of the axes.
        """
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
        """Try all weights with equal axes; return the smallest that leaves no correction."""
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
        """Return the smoothest node whose score is as good as the best."""
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
        """Try the weights between on a line with a good score: the grid may miss its peak."""
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
        """Try larger and smaller weights from a node while a good score is possible.

        Args:
            axes: steps of the relative weights of the axes.
            start: step of the weight at which the search begins.
            stride: steps between trials.
            reach: largest distance from ``start``, in steps.
        """
        for way in (stride, -stride):
            step, before = start, np.inf
            while abs(step) <= MAX_STEPS:
                total = self.trial(step, axes).total
                least = min(trial.total for trial in self.evaluated.values())
                if (
                    total > min(least + ABANDON_DEVIANCE_THRESHOLD, before)
                    or abs(step - start) > reach
                ):
                    break
                step, before = step + way, max(total, least + ABANDON_DEVIANCE_THRESHOLD)


def step_widths(nodes: list[tuple[int, Axes]]) -> Array:
    """Return the share of its line that each node represents, in steps."""
    widths = np.empty(len(nodes))
    for number, (step, axes) in enumerate(nodes):
        others = [other for other, same in nodes if same == axes and other != step]
        above = min((other - step for other in others if other > step), default=COARSE_STRIDE)
        below = min((step - other for other in others if other < step), default=COARSE_STRIDE)
        widths[number] = 0.5 * (min(above, COARSE_STRIDE) + min(below, COARSE_STRIDE))
    return widths
