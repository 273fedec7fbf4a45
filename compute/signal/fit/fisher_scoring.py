"""Fisher scoring of the same number of peaks in many windows at once, with covariances."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.signal.fit.fit_settings import (
    CONVERGENCE_THRESHOLD_SIGMA,
    MAX_ITERATIONS,
    MIN_PIVOT,
    STEP_LOG_WIDTH,
    STEP_WIDTHS,
    WIDTH_LIMITS_PX,
    FitSettings,
)
from compute.signal.fit.line_spread_function import LineSpreadFunction
from compute.signal.fit.score_information import ScoreInformation
from compute.signal.fit.window_model import Array, Layout, Windows

_BLOCK = 4096  # windows that are worked on at once
_WIDTH_LIMITS = np.log(WIDTH_LIMITS_PX)


@dataclass(frozen=True, eq=False)
class Solution:
    """Fits of N windows by Q parameters each; results are NaN where one failed.

    Args:
        good: the fit converged to something possible, shape (N,).
        parameters: in the order of ``Layout``, shape (N, Q).
        covariance: theirs, shape (N, Q, Q); zero for a width that is known.
        chi2: misfit, the width's prior among it, shape (N,).
        dof: its degrees of freedom, shape (N,).
        deviance: ``sum ((v - mu)^2/V + ln V)`` and the prior's term, shape (N,); of a fit that
            failed, the least on its way.
        evaluations: how often the model was worked out, shape (N,).
    """

    good: NDArray[np.bool_]
    parameters: Array
    covariance: Array
    chi2: Array
    dof: NDArray[np.int64]
    deviance: Array
    evaluations: NDArray[np.int64]

    def __getitem__(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> "Solution":
        """Return some of the fits."""
        return Solution(*(values[rows] for values in vars(self).values()))

    @classmethod
    def none(cls, start: Array, dof: NDArray[np.int64]) -> "Solution":
        """Return N failed fits, to be filled in.

        Args:
            start: initial parameters, shape (N, Q).
            dof: degrees of freedom, shape (N,).
        """
        count, size = start.shape
        return cls(
            np.zeros(count, bool),
            start.copy(),
            np.full((count, size, size), np.nan),
            np.full(count, np.nan),
            dof,
            np.full(count, np.inf),
            np.zeros(count, np.int64),
        )


def solve(
    windows: Windows, start: Array, layout: Layout, settings: FitSettings, shape: LineSpreadFunction
) -> Solution:
    """Fit ``layout.peaks`` peaks to each window, as ``FitSettings`` defines it.

    Args:
        windows: N windows.
        start: parameters to start with, shape (N, Q).
        layout: their order.
        settings: of the fit.
        shape: the line-spread function.
    """
    free = layout.size - (settings.width_log_sigma == 0.0)
    counted = windows.count
    dof = counted - free + (0.0 < settings.width_log_sigma < np.inf)
    solution = Solution.none(start, dof)
    possible = np.flatnonzero(counted > free)
    for begin in range(0, len(possible), _BLOCK):
        _iterate(windows, possible[begin : begin + _BLOCK], solution, layout, settings, shape)
    return solution


def _iterate(
    windows: Windows,
    active: NDArray[np.int64],
    solution: Solution,
    layout: Layout,
    settings: FitSettings,
    shape: LineSpreadFunction,
) -> None:
    """Fit some of the windows, into ``solution``."""
    last = np.zeros(len(solution.good))
    for number in range(1, MAX_ITERATIONS + 1):
        if len(active) == 0:
            break
        part = windows[active]
        parameters = solution.parameters[active]
        step = _scoring_step(part, parameters, layout, settings, shape)
        solution.evaluations[active] = number
        # Where the shape misfits, steps shrink slowly: noise alone would ask for too many.
        misfit = np.maximum(step.chi2 / solution.dof[active], 1.0)
        ended = step.regular & (step.length2 < CONVERGENCE_THRESHOLD_SIGMA**2 * misfit)
        part_taken = _step_fraction(step, parameters, layout, last[active])
        taken = np.where(ended[:, None], 1.0, part_taken) * step.step
        moved = parameters + taken
        moved[:, -1] = np.clip(moved[:, -1], *_WIDTH_LIMITS)
        last[active] = moved[:, -1] - parameters[:, -1]
        place = moved[:, layout.position]
        inside = (place >= part.first_px[:, None] - 0.5) & (place <= part.last_px[:, None] + 0.5)
        possible = step.regular & inside.all(axis=1)
        solution.parameters[active] = moved
        done = possible & ended
        variance = np.einsum("nqq->nq", step.covariance)[:, layout.light]
        lit = (moved[:, layout.light] > np.sqrt(np.maximum(variance, 0.0))).all(axis=1)
        rows = active[done & lit]
        solution.good[rows] = True
        solution.deviance[active] = np.minimum(solution.deviance[active], step.deviance)
        for name in ("covariance", "chi2", "deviance"):
            getattr(solution, name)[rows] = getattr(step, name)[done & lit]
        active = active[possible & ~ended]


@dataclass(frozen=True, eq=False)
class _Step:
    """A step of N fits, and what was known before it."""

    step: Array
    length2: Array
    regular: NDArray[np.bool_]
    covariance: Array
    chi2: Array
    deviance: Array


def _scoring_step(
    windows: Windows,
    parameters: Array,
    layout: Layout,
    settings: FitSettings,
    shape: LineSpreadFunction,
) -> _Step:
    sums = ScoreInformation.of(windows, parameters, layout, settings, shape)
    score, information = sums.score, sums.information
    held = _at_limit(parameters[:, -1], score[:, -1], known=settings.width_log_sigma == 0.0)
    score[held, -1] = 0.0
    information[held, -1, :] = information[held, :, -1] = 0.0
    information[held, -1, -1] = 1.0
    covariance, regular = _inverse(information)
    covariance[held, -1, -1] = 0.0
    step = (covariance @ score[..., None])[..., 0]
    length2 = (step * score).sum(axis=1)
    return _Step(step, length2, regular, covariance, sums.chi2, sums.deviance)


def _at_limit(log_width: Array, score: Array, *, known: bool) -> NDArray[np.bool_]:
    """Say which widths are known, or stay at a limit that they would leave."""
    low, high = _WIDTH_LIMITS
    outward = ((log_width <= low) & (score < 0.0)) | ((log_width >= high) & (score > 0.0))
    return np.ones_like(outward) if known else outward


def _step_fraction(step: _Step, parameters: Array, layout: Layout, last: Array) -> Array:
    """Return the part of each step that is taken, shape (N, 1).

    Args:
        step: the steps.
        parameters: from which they start.
        layout: their order.
        last: changes of the widths' logarithms by the steps before, shape (N,).
    """
    width = np.exp(parameters[:, -1])
    farthest = np.abs(step.step[:, layout.position]).max(axis=1) / (STEP_WIDTHS * width)
    broadest = np.abs(step.step[:, -1]) / STEP_LOG_WIDTH
    part = 1.0 / np.maximum(np.maximum(farthest, broadest), 1.0)
    # Where one line's width turns back, the secant's step: else it may go to and fro for ever.
    turned = (step.step[:, -1] * last < 0.0) & (layout.peaks == 1)
    change = np.abs(step.step[turned, -1]) * part[turned]
    before = np.abs(last[turned])
    part[turned] *= before / (before + change)
    return np.asarray(part)[:, None]


def _inverse(matrices: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the inverses of N symmetric matrices, and which of them are positive definite.

    Gauss and Jordan's elimination without exchanges: its pivots are Cholesky's.
    """
    diagonal = np.einsum("nii->ni", matrices)
    regular = (diagonal > 0.0).all(axis=1) & np.isfinite(matrices).all(axis=(1, 2))
    scale = np.where(regular[:, None], diagonal, 1.0) ** -0.5
    whole = np.where(regular[:, None, None], matrices * scale[:, :, None] * scale[:, None, :], 0.0)
    size = matrices.shape[1]
    for k in range(size):
        pivot = whole[:, k, k].copy()
        regular &= pivot >= MIN_PIVOT
        pivot[~regular] = 1.0
        row = whole[:, k, :] / pivot[:, None]
        column = whole[:, :, k].copy()
        whole -= column[:, :, None] * row[:, None, :]
        whole[:, k, :] = row
        whole[:, :, k] = -column / pivot[:, None]
        whole[:, k, k] = 1.0 / pivot
        whole[~regular] = 0.0
    return whole * scale[:, :, None] * scale[:, None, :], regular
