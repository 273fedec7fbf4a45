"""Covariances of faint peaks, marginalised over the unknown width."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.signal.fit.fisher_scoring import Solution
from compute.signal.fit.fit_settings import (
    LOG_WIDTH_SIGMA_THRESHOLD,
    MAX_LOG_LIKELIHOOD_RISE,
    MAX_WIDTH_NODES,
    MIN_LOG_WEIGHT,
    MIN_PIVOT,
    STEP_LOG_WIDTH,
    WIDTH_LIMITS_PX,
)
from compute.signal.fit.window_model import Array, WindowModel, Windows

_LOW, _HIGH = np.log(WIDTH_LIMITS_PX)
_SIDES: Final = (-1.0, 1.0)


def marginalise_width(model: WindowModel, windows: Windows, solution: Solution) -> Solution:
    """Return fits whose covariances are averaged over the width where it is not determined.

    At a given width the other parameters' errors are all but normal, yet their deviations change
    with it: so each of a row of widths has its own best parameters, their covariance, and a
    weight (the nested approximation of H. Rue, S. Martino and N. Chopin,
    10.1111/j.1467-9868.2008.00700.x). The parameters stay the best ones; see ``FitSettings``,
    *Unknown width*.

    Args:
        model: the model.
        windows: N windows.
        solution: their fits; those that are not good stay as they are.
    """
    variance = solution.covariance[:, -1, -1]
    # Zero where the width is held at a limit.
    is_open = (variance > LOG_WIDTH_SIGMA_THRESHOLD**2) | (variance == 0.0)
    rows = np.flatnonzero(solution.good & is_open & (model.settings.width_log_sigma > 0.0))
    if len(rows) == 0:
        return solution
    average, regular = _average_covariance(model, windows[rows], solution.parameters[rows])
    covariance = solution.covariance.copy()
    covariance[rows[regular]] = average[regular]
    return replace(solution, covariance=covariance)


@dataclass(frozen=True, eq=False)
class _Nodes:
    """Fits of the other parameters at one width each, of N peaks.

    Args:
        parameters: the best at this width, shape (N, Q).
        covariance: of those but the width, shape (N, Q - 1, Q - 1).
        width_derivative: how these change with the logarithm of the width, shape (N, Q - 1).
        score: slope of the likelihood's logarithm along these, with the prior, shape (N,).
        information: of the width, the others unknown, shape (N,).
        log_sigma: logarithm of the positions' deviations, their mean, shape (N,).
        regular: there is such a node, and all of its lights are positive, shape (N,).
    """

    parameters: Array
    covariance: Array
    width_derivative: Array
    score: Array
    information: Array
    log_sigma: Array
    regular: NDArray[np.bool_]

    def shift_log_width(self, apart: Array) -> Array:
        """Return parameters at widths whose logarithms are ``apart`` from these, shape (N, Q)."""
        parameters = self.parameters.copy()
        parameters[:, :-1] += self.width_derivative * apart[:, None]
        parameters[:, -1] += apart
        return parameters


def _nodes(model: WindowModel, windows: Windows, parameters: Array) -> _Nodes:
    """Take one scoring step, at the widths of ``parameters``, to the best of the others."""
    sums = model.score_information(windows, parameters)
    score, information = sums.score, sums.information
    root, regular = _roots(information)
    diagonal = np.einsum("nii->ni", root)
    half = np.linalg.inv(root[:, :-1, :-1])
    covariance = half.transpose(0, 2, 1) @ half
    step = (covariance @ score[:, :-1, None])[..., 0]
    best = parameters.copy()
    best[:, :-1] += step
    return _Nodes(
        best,
        covariance,
        -(covariance @ information[:, :-1, -1:])[..., 0],
        score[:, -1] - (information[:, -1, :-1] * step).sum(axis=1),
        diagonal[:, -1] ** 2,
        -np.log(diagonal[:, model.position]).mean(axis=1),
        regular & windows.contain(best[:, model.position]) & (best[:, model.light] > 0.0).all(1),
    )


def _roots(matrices: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return Cholesky's roots of N symmetric matrices, and which of them are positive definite.

    The root of one that is not is a matrix of ones on the diagonal.
    """
    size = matrices.shape[1]
    diagonal = np.einsum("nii->ni", matrices)
    regular = np.isfinite(matrices).all(axis=(1, 2)) & (diagonal > 0.0).all(axis=1)
    root = np.where(regular[:, None, None], matrices, np.eye(size))
    least = MIN_PIVOT * np.einsum("nii->ni", root)
    for k in range(size):
        pivot = root[:, k, k] - (root[:, k, :k] ** 2).sum(axis=1)
        regular &= pivot >= least[:, k]
        root[:, k, k] = np.sqrt(np.where(regular, pivot, 1.0))
        below = root[:, k + 1 :, :k] @ root[:, k, :k, None]
        root[:, k + 1 :, k] = (root[:, k + 1 :, k] - below[..., 0]) / root[:, k, k, None]
    return np.where(regular[:, None, None], np.tril(root), np.eye(size)), regular


def _average_covariance(
    model: WindowModel, windows: Windows, best: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the covariances of averages over the width, and where there are such.

    Args:
        model: the model.
        windows: N windows.
        best: parameters to start from, shape (N, Q).
    """
    middle = _nodes(model, windows, best)
    step = np.minimum(middle.information**-0.5, STEP_LOG_WIDTH)
    total = np.ones(len(best))
    # Moments of the distances from the middle.
    first = np.zeros_like(best)
    second = np.zeros((*best.shape, best.shape[1]))
    second[:, :-1, :-1] = middle.covariance
    for side in _SIDES:
        before, rise, going = middle, np.zeros(len(best)), middle.regular
        for _ in range(MAX_WIDTH_NODES):
            node = _nodes(model, windows, before.shift_log_width(side * step))
            rise = rise + 0.5 * (before.score + node.score) * side * step
            weight = rise + node.log_sigma - middle.log_sigma
            log_width = node.parameters[:, -1]
            within = (log_width >= _LOW) & (log_width <= _HIGH)
            # NaN and infinity, too, end a side.
            going = going & within & node.regular & (weight > MIN_LOG_WEIGHT)
            going &= rise < MAX_LOG_LIKELIHOOD_RISE
            if not going.any():
                break
            part = np.exp(np.where(going, weight, -np.inf))
            away = np.where(going[:, None], node.parameters - middle.parameters, 0.0)
            given = np.where(going[:, None, None], node.covariance, 0.0)
            total += part
            first += part[:, None] * away
            second += part[:, None, None] * away[:, :, None] * away[:, None, :]
            second[:, :-1, :-1] += part[:, None, None] * given
            before = node
    first /= total[:, None]
    covariance = second / total[:, None, None] - first[:, :, None] * first[:, None, :]
    return covariance, middle.regular
