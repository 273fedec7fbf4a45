"""Beam search over label-error hypotheses in the linearised camera, with closed-form residuals."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.mislabels.hypothesis import (
    Evidence,
    Hypothesis,
    log_exchange_prior,
)

Array = NDArray[np.float64]

MAX_PAIRS_PER_BATCH: Final = 90_000
"""Largest number of ordered pairs of readings evaluated at a time; bounds the memory."""
BEAM_WIDTH: Final = 16
"""Explanations that are taken further at each level, for up to about 100 readings."""
MAX_PAIR_VALUES: Final = 240_000
"""Largest number of pairs examined in one level: many readings narrow the beam."""
MAX_LEVELS: Final = 12
MAX_SHRUNK: Final = 6
"""Explanations of a level, the best ones, that are also tried with fewer errors."""
MAX_LEVELS_WITHOUT_GAIN: Final = 2
"""Levels without a better explanation before the search ends: two errors may hide each other."""
TIE_TOLERANCE: Final = 1e-9
"""Redundancy 1 - h of a reading that the others say nothing about."""


@dataclass(frozen=True, eq=False)
class LinearisedCamera:
    """A camera linearised at a solution, over the n readings of a sensor.

    Args:
        basis: orthonormal columns that span J over sigma, shape (n, width).
        fitted: readings that the camera predicts, shape (n,) [px].
        readings: readings of the sensor, shape (n,) [px].
        sigma: standard deviations, shape (n,) [px].
        evidence: marginal likelihood of hypotheses.
    """

    basis: Array
    fitted: Array
    readings: Array
    sigma: Array
    evidence: Evidence

    @cached_property
    def pairs(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """All pairs of readings, the lower one first."""
        first, second = np.triu_indices(len(self.readings), 1)
        return first, second

    @cached_property
    def flat_pairs(self) -> NDArray[np.intp]:
        """Indices of the pairs in a flattened (n, n)."""
        first, second = self.pairs
        return np.asarray(first * len(self.readings) + second)

    @cached_property
    def changes(self) -> Array:
        """Change of a normalised residual when another point's reading is put there, shape (n, n).

        Row: the point; column: the reading that is put there.
        """
        return np.asarray((self.readings - self.readings[:, None]) / self.sigma[:, None])

    @cached_property
    def cross_terms(self) -> Array:
        """Minus twice the product of both changes of a pair, shape (n, n)."""
        return np.asarray(-2.0 * self.changes * self.changes.T)

    @cached_property
    def batch_size(self) -> int:
        """Number of hypotheses whose pairs are evaluated at a time."""
        return max(MAX_PAIRS_PER_BATCH // len(self.readings) ** 2, 1)

    @cached_property
    def workspace(self) -> Array:
        """Two work arrays of a batch, (batch, n, n) each; allocated once, as that takes long."""
        return np.empty((2, self.batch_size, len(self.readings), len(self.readings)))


@dataclass(frozen=True, eq=False)
class EvaluatedHypotheses:
    """B hypotheses with their residuals, sums of squares and determinants.

    ``basis`` is of the readings kept, (B, n, width), and ``gain`` @ its transpose the hat matrix;
    ``inverse`` is of the normal equations and ``theta`` their solution.
    """

    hypotheses: Sequence[Hypothesis]
    residual: Array
    basis: Array
    gain: Array
    inverse: Array
    theta: Array
    used: NDArray[np.bool_]
    chi2: Array
    count: Array
    log_determinant: Array
    log_sigma: Array


def evaluate_hypotheses(
    camera: LinearisedCamera, hypotheses: Sequence[Hypothesis]
) -> EvaluatedHypotheses:
    """Evaluate hypotheses, each from its own normal equations.

    Args:
        camera: the linearised camera.
        hypotheses: B hypotheses.
    """
    n = len(camera.readings)
    repaired = [h.repair(camera.readings, camera.sigma) for h in hypotheses]
    readings = np.array([one for one, _ in repaired]).reshape(-1, n)
    sigma = np.array([one for _, one in repaired]).reshape(-1, n)
    used = np.isfinite(readings)
    # The basis holds J over the sigma of the point's own reading, also where another was put.
    misfit = np.where(used, np.where(used, readings, 0.0) - camera.fitted, 0.0) / camera.sigma
    basis = camera.basis * used[..., None]
    normal = basis.swapaxes(1, 2) @ basis
    inverse = np.linalg.inv(normal + 1e-12 * np.eye(camera.evidence.parameters))
    gain = basis @ inverse
    theta = (inverse @ (basis.swapaxes(1, 2) @ misfit[..., None]))[..., 0]
    residual = misfit - (basis @ theta[..., None])[..., 0]
    return EvaluatedHypotheses(
        hypotheses,
        residual,
        basis,
        gain,
        inverse,
        theta,
        used,
        (residual**2).sum(axis=1),
        used.sum(axis=1),
        np.linalg.slogdet(normal)[1],
        np.where(used, np.log(sigma), 0.0).sum(axis=1),
    )


def _outlier_counts(hypotheses: Sequence[Hypothesis]) -> Array:
    return np.array([float(len(h.outliers)) for h in hypotheses])


def _log_priors(camera: LinearisedCamera, hypotheses: Sequence[Hypothesis]) -> Array:
    return np.array([h.log_prior(len(camera.readings), 0) for h in hypotheses])


def log_posteriors(camera: LinearisedCamera, states: EvaluatedHypotheses) -> Array:
    """Return the unnormalised log posteriors, shape (B,); -inf with too few readings kept.

    Args:
        camera: the linearised camera.
        states: B evaluated hypotheses.
    """
    likelihood = camera.evidence.log_likelihood(
        states.chi2,
        states.count,
        states.log_determinant,
        states.log_sigma,
        camera.evidence.log_outlier * _outlier_counts(states.hypotheses),
    )
    score = likelihood + _log_priors(camera, states.hypotheses)
    return np.where(states.count > camera.evidence.parameters, score, -np.inf)


def beam_search(
    camera: LinearisedCamera, seeds: Iterable[Hypothesis], count: int, beam: int = BEAM_WIDTH
) -> list[tuple[float, Hypothesis]]:
    """Return the ``count`` best hypotheses with their unnormalised log posterior.

    A beam over sets of outliers and exchanged pairs. From each explanation: one outlier
    more, one exchanged pair more (squares by the residuals r and the redundancy matrix
    Q = I - H: leaving out i gains r_i^2 / Q_ii, exchanging changes the readings by v and adds
    2 v'r + v'Qv), one error fewer, two outliers as one exchanged pair.

    Args:
        camera: the linearised camera; points are counted within its readings.
        seeds: explanations to start from.
        count: wanted.
        beam: explanations that are taken further at each level.
    """
    n = len(camera.readings)
    width = int(np.clip(MAX_PAIR_VALUES // n**2, 4, beam))
    scores: dict[Hypothesis, float] = {}
    states = evaluate_hypotheses(camera, list(dict.fromkeys(seeds)))
    _record(scores, zip(log_posteriors(camera, states).tolist(), states.hypotheses, strict=True))
    best, waited = max(scores.values()), 0
    for _ in range(MAX_LEVELS):
        grown = dict[Hypothesis, float]()
        _record(grown, _extend(camera, states, 2 * width))
        _record(grown, _reduce(camera, states, 4 * width))
        fresh = [(score, h) for h, score in grown.items() if h not in scores]
        if not fresh:
            break
        fresh.sort(key=_by_score)
        _record(scores, fresh[: 4 * width])
        if fresh[0][0] > best + 1e-9:
            best, waited = fresh[0][0], 0
        else:
            waited += 1
            if waited == MAX_LEVELS_WITHOUT_GAIN:
                break
        states = evaluate_hypotheses(camera, [h for _, h in fresh[:width]])
    return sorted(((score, h) for h, score in scores.items()), key=_by_score)[:count]


def _by_score(entry: tuple[float, Hypothesis]) -> tuple[float, int, list[int]]:
    return -entry[0], entry[1].size, sorted(entry[1].affected_points)


def _record(scores: dict[Hypothesis, float], entries: Iterable[tuple[float, Hypothesis]]) -> None:
    for score, hypothesis in entries:
        if np.isfinite(score):
            scores.setdefault(hypothesis, score)


def _extend(
    camera: LinearisedCamera, states: EvaluatedHypotheses, count: int
) -> list[tuple[float, Hypothesis]]:
    """Return the best hypotheses with one more outlier or exchanged pair."""
    n = len(camera.readings)
    redundancy = states.used - np.einsum("bnw,bnw->bn", states.gain, states.basis)
    free = np.ones(redundancy.shape, dtype=bool)
    for row, hypothesis in enumerate(states.hypotheses):
        free[row, list(hypothesis.affected_points)] = False
    outliers = camera.evidence.log_outlier * _outlier_counts(states.hypotheses)[:, None]
    prior = _log_priors(camera, states.hypotheses)[:, None]
    usable = (
        free
        & (redundancy > TIE_TOLERANCE)
        & (states.count[:, None] - 1 > camera.evidence.parameters)
    )
    safe = np.where(usable, redundancy, 1.0)
    excluded = camera.evidence.log_likelihood(
        np.maximum(states.chi2[:, None] - states.residual**2 / safe, 0.0),
        states.count[:, None] - 1,
        states.log_determinant[:, None] + np.log(safe),
        states.log_sigma[:, None] - np.log(camera.sigma),
        outliers + camera.evidence.log_outlier,
    )
    excluded = np.where(usable, excluded + prior, -np.inf)

    parts = [
        _best_exchanges(
            camera, states, redundancy, free, count, slice(row, row + camera.batch_size)
        )
        for row in range(0, len(redundancy), camera.batch_size)
    ]
    squares, pair = (np.concatenate(part) for part in zip(*parts, strict=True))
    exchanged = camera.evidence.log_likelihood(
        np.maximum(states.chi2[:, None] + squares, 0.0),
        states.count[:, None],
        states.log_determinant[:, None],
        states.log_sigma[:, None],
        outliers,
    )
    exchanged = np.where(np.isfinite(squares), exchanged + prior + log_exchange_prior(n), -np.inf)

    scores = np.concatenate([excluded, exchanged], axis=1)
    grown = []
    for row, column in _best(scores, count):
        base = states.hypotheses[row]
        if column < n:
            extended = base.with_outlier(column)
        else:
            pair_index = pair[row, column - n]
            extended = base.with_cycle(
                (int(camera.pairs[0][pair_index]), int(camera.pairs[1][pair_index]))
            )
        grown.append((float(scores[row, column]), extended))
    return grown


def _best_exchanges(
    camera: LinearisedCamera,
    states: EvaluatedHypotheses,
    redundancy: Array,
    free: NDArray[np.bool_],
    count: int,
    rows: slice,
) -> tuple[Array, NDArray[np.intp]]:
    """Return the pairs whose exchange leaves the smallest sum of squares: its change, and which."""
    n = len(camera.readings)
    # v'Qv of the hat matrix's share; a pair lies off its diagonal.
    squares, alone = camera.workspace[:, : len(redundancy[rows])]
    np.matmul(states.gain[rows], states.basis[rows].swapaxes(1, 2), out=squares)
    squares *= camera.cross_terms
    np.multiply(camera.changes, redundancy[rows, :, None], out=alone)
    alone += 2.0 * states.residual[rows, :, None]
    alone *= camera.changes
    alone[~free[rows]] = np.inf
    squares += alone
    squares += alone.swapaxes(1, 2)
    flat = camera.flat_pairs
    workspace = alone.reshape(-1)[: len(squares) * len(flat)].reshape(len(squares), -1)
    added = np.take(squares.reshape(-1, n * n), flat, axis=1, out=workspace, mode="clip")
    most = min(count, len(flat))
    pair = np.argpartition(added, most - 1, axis=1)[:, :most]
    return np.take_along_axis(added, pair, axis=1), pair


def _best(scores: Array, count: int) -> list[tuple[int, int]]:
    """Return rows and columns of the ``count`` highest scores."""
    flat = np.argpartition(-scores, min(count, scores.size - 1), axis=None)[:count]
    return [divmod(index, scores.shape[1]) for index in flat.tolist()]


def _reduce(
    camera: LinearisedCamera, states: EvaluatedHypotheses, count: int
) -> list[tuple[float, Hypothesis]]:
    """Return hypotheses with one error fewer, or two outliers as an exchanged pair."""
    hypotheses: list[tuple[float, Hypothesis]] = []
    undone: dict[Hypothesis, None] = {}
    for row, hypothesis in enumerate(states.hypotheses[:MAX_SHRUNK]):
        hypotheses += _with_outlier_restored(camera, states, row, count)
        for cycle in sorted(hypothesis.cycles):
            undone.setdefault(hypothesis.without(cycle))
    if undone:
        worked = evaluate_hypotheses(camera, list(undone))
        hypotheses += zip(log_posteriors(camera, worked).tolist(), worked.hypotheses, strict=True)
    return hypotheses


def _with_outlier_restored(
    camera: LinearisedCamera, states: EvaluatedHypotheses, row: int, count: int
) -> list[tuple[float, Hypothesis]]:
    """Return the best hypotheses with one outlier fewer, or two of them exchanged."""
    base = states.hypotheses[row]
    outliers = np.array(sorted(base.outliers), dtype=np.intp)
    if len(outliers) == 0:
        return []
    basis = camera.basis[outliers]
    gain = basis @ states.inverse[row] @ basis.T
    # Of the reading labelled with the second at the place of the first, off by:
    fitted = camera.fitted[outliers] + camera.sigma[outliers] * (basis @ states.theta[row])
    off = (camera.readings[outliers] - fitted[:, None]) / camera.sigma[outliers, None]
    variance = 1.0 + gain.diagonal()
    first, second = np.triu_indices(len(outliers), 1)
    across = gain[first, second]
    determinant = variance[first] * variance[second] - across**2
    here, there = off[first, second], off[second, first]
    added = (
        variance[second] * here**2 - 2.0 * across * here * there + variance[first] * there**2
    ) / (determinant)
    log_sigma = np.log(camera.sigma[outliers])
    pairs = len(first)
    likelihood = camera.evidence.log_likelihood(
        states.chi2[row] + np.concatenate([off.diagonal() ** 2 / variance, added]),
        states.count[row] + np.repeat([1, 2], [len(outliers), pairs]),
        states.log_determinant[row] + np.log(np.concatenate([variance, determinant])),
        states.log_sigma[row] + np.concatenate([log_sigma, log_sigma[first] + log_sigma[second]]),
        camera.evidence.log_outlier * (len(outliers) - np.repeat([1, 2], [len(outliers), pairs])),
    )
    prior = base.log_prior(len(camera.readings), 0)
    as_pair = log_exchange_prior(len(camera.readings))
    scores = likelihood + prior + np.repeat([0.0, as_pair], [len(outliers), pairs])
    extended_hypotheses = []
    for _, index in _best(scores[None], count):
        if index < len(outliers):
            extended = base.without(int(outliers[index]))
        else:
            pair_index = index - len(outliers)
            extended = base.with_cycle(
                (int(outliers[first[pair_index]]), int(outliers[second[pair_index]]))
            )
        extended_hypotheses.append((float(scores[index]), extended))
    return extended_hypotheses
