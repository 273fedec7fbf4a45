"""Fisher scoring of the same number of peaks in many windows at once, with covariances."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.signal.array_rows import ArrayRows
from compute.signal.fit.fit_settings import (
    CONVERGENCE_THRESHOLD_SIGMA,
    MAX_ITERATIONS,
    MIN_PIVOT,
    STEP_LOG_WIDTH,
    STEP_WIDTHS,
    WIDTH_LIMITS_PX,
)
from compute.signal.fit.window_model import Array, WindowModel, Windows

_BLOCK = 4096  # windows that are worked on at once
_WIDTH_LIMITS = np.log(WIDTH_LIMITS_PX)


@dataclass(frozen=True, eq=False)
class Solution(ArrayRows):
    """Fits of N windows by Q parameters each; results are NaN where one failed.

    Args:
        good: the fit converged to something possible, shape (N,).
        parameters: in the order of ``WindowModel``, shape (N, Q).
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


def solve(model: WindowModel, windows: Windows, start: Array) -> Solution:
    """Fit ``model.peaks`` peaks to each window, as ``FitSettings`` defines it.

    Args:
        model: the model.
        windows: N windows.
        start: parameters to start with, shape (N, Q).
    """
    sigma = model.settings.width_log_sigma
    free = model.size - (sigma == 0.0)
    counted = windows.count
    count, size = start.shape
    solution = Solution(
        np.zeros(count, bool),
        start.copy(),
        np.full((count, size, size), np.nan),
        np.full(count, np.nan),
        counted - free + (0.0 < sigma < np.inf),
        np.full(count, np.inf),
        np.zeros(count, np.int64),
    )
    possible = np.flatnonzero(counted > free)
    for begin in range(0, len(possible), _BLOCK):
        _iterate(model, windows, possible[begin : begin + _BLOCK], solution)
    return solution


def _iterate(
    model: WindowModel, windows: Windows, active: NDArray[np.int64], solution: Solution
) -> None:
    """Fit some of the windows, into ``solution``."""
    last = np.zeros(len(solution.good))
    for number in range(1, MAX_ITERATIONS + 1):
        if len(active) == 0:
            break
        part = windows[active]
        parameters = solution.parameters[active]
        step = _scoring_step(model, part, parameters)
        solution.evaluations[active] = number
        # Where the shape misfits, steps shrink slowly: noise alone would ask for too many.
        misfit = np.maximum(step.chi2 / solution.dof[active], 1.0)
        ended = step.regular & (step.length2 < CONVERGENCE_THRESHOLD_SIGMA**2 * misfit)
        fraction = _step_fraction(model, step, parameters, last[active])
        updated = parameters + np.where(ended[:, None], 1.0, fraction) * step.step
        updated[:, -1] = np.clip(updated[:, -1], *_WIDTH_LIMITS)
        last[active] = updated[:, -1] - parameters[:, -1]
        possible = step.regular & part.contain(updated[:, model.position])
        solution.parameters[active] = updated
        variance = np.einsum("nqq->nq", step.covariance)[:, model.light]
        lit = (updated[:, model.light] > np.sqrt(np.maximum(variance, 0.0))).all(axis=1)
        converged = possible & ended & lit
        rows = active[converged]
        solution.good[rows] = True
        solution.deviance[active] = np.minimum(solution.deviance[active], step.deviance)
        for name in ("covariance", "chi2", "deviance"):
            getattr(solution, name)[rows] = getattr(step, name)[converged]
        active = active[possible & ~ended]


@dataclass(frozen=True, eq=False)
class _Step:
    """Scoring step of N fits, with the covariance and misfit at its start."""

    step: Array
    length2: Array
    regular: NDArray[np.bool_]
    covariance: Array
    chi2: Array
    deviance: Array


def _scoring_step(model: WindowModel, windows: Windows, parameters: Array) -> _Step:
    sums = model.score_information(windows, parameters)
    score, information = sums.score, sums.information
    width_known = model.settings.width_log_sigma == 0.0
    at_limit = _at_limit(parameters[:, -1], score[:, -1], width_known=width_known)
    score[at_limit, -1] = 0.0
    information[at_limit, -1, :] = information[at_limit, :, -1] = 0.0
    information[at_limit, -1, -1] = 1.0
    covariance, regular = _inverse(information)
    covariance[at_limit, -1, -1] = 0.0
    step = (covariance @ score[..., None])[..., 0]
    length2 = (step * score).sum(axis=1)
    return _Step(step, length2, regular, covariance, sums.chi2, sums.deviance)


def _at_limit(log_width: Array, score: Array, *, width_known: bool) -> NDArray[np.bool_]:
    """Say which widths are known, or stay at a limit that they would leave."""
    low, high = _WIDTH_LIMITS
    outward = ((log_width <= low) & (score < 0.0)) | ((log_width >= high) & (score > 0.0))
    return np.ones_like(outward) if width_known else outward


def _step_fraction(model: WindowModel, step: _Step, parameters: Array, last: Array) -> Array:
    """Return the fraction of each step that is applied, shape (N, 1).

    Args:
        model: the model.
        step: the steps.
        parameters: from which they start.
        last: changes of the widths' logarithms by the steps before, shape (N,).
    """
    width = np.exp(parameters[:, -1])
    farthest = np.abs(step.step[:, model.position]).max(axis=1) / (STEP_WIDTHS * width)
    broadest = np.abs(step.step[:, -1]) / STEP_LOG_WIDTH
    part = 1.0 / np.maximum(np.maximum(farthest, broadest), 1.0)
    # Where one line's width turns back, the secant's step: else it may go to and fro for ever.
    turned = (step.step[:, -1] * last < 0.0) & (model.peaks == 1)
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
    matrix = np.where(regular[:, None, None], matrices * scale[:, :, None] * scale[:, None, :], 0.0)
    size = matrices.shape[1]
    for k in range(size):
        pivot = matrix[:, k, k].copy()
        regular &= pivot >= MIN_PIVOT
        pivot[~regular] = 1.0
        row = matrix[:, k, :] / pivot[:, None]
        column = matrix[:, :, k].copy()
        matrix -= column[:, :, None] * row[:, None, :]
        matrix[:, k, :] = row
        matrix[:, :, k] = -column / pivot[:, None]
        matrix[:, k, k] = 1.0 / pivot
        matrix[~regular] = 0.0
    return matrix * scale[:, :, None] * scale[:, None, :], regular
