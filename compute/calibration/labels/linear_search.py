"""Search over explanations in the linearised camera, where each one's squares are closed-form."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import log
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.labels.evidence import Evidence
from compute.calibration.labels.hypothesis import WRONG_CHANCE, Hypothesis, log_exchange

Array = NDArray[np.float64]

BEAM: Final = 16
"""Explanations that are taken further at each level, for up to about 100 readings."""
PAIR_ROOM: Final = 240_000
"""Pairs looked at in one level: many readings narrow the beam."""
LEVELS: Final = 12
SHRUNK: Final = 6
"""Explanations of a level, the best ones, that are also tried with fewer errors."""
PATIENCE: Final = 2
"""Levels without a better explanation before the search ends: two errors may hide each other."""
PAIRS: Final = 200
"""Pairs of an explanation's wrong readings that are tried as exchanged."""
TOGETHER: Final = 200
"""Explanations worked out at a time: bounds the memory."""
TIED: Final = 1e-9
"""Redundancy 1 - h of a reading that the others say nothing about."""


@dataclass(frozen=True, eq=False)
class LinearCamera:
    """A camera linearised at a solution, over the n readings that the sensor has.

    Args:
        basis: orthonormal columns that span J over sigma, shape (n, width).
        fitted: what the camera reads, shape (n,) [px].
        readings: what the sensor read, shape (n,) [px].
        sigma: deviations, shape (n,) [px].
        evidence: of the explanations.
    """

    basis: Array
    fitted: Array
    readings: Array
    sigma: Array
    evidence: Evidence


@dataclass(frozen=True, eq=False)
class _States:
    """Explanations worked out: their residuals, squares, determinants.

    ``basis`` is of what is kept, (B, n, width), and ``spread`` @ its transpose the hat matrix.
    """

    explained: Sequence[Hypothesis]
    residual: Array
    basis: Array
    spread: Array
    used: NDArray[np.bool_]
    chi2: Array
    kept: Array
    log_determinant: Array
    log_sigma: Array


def explore(
    camera: LinearCamera, seeds: Iterable[Hypothesis], count: int, beam: int = BEAM
) -> list[tuple[float, Hypothesis]]:
    """Return the ``count`` best explanations found, with their log posterior but for a constant.

    A beam over sets of wrong readings and exchanged pairs. From each explanation: one reading
    more wrong, one pair more exchanged (squares by the residuals r and the redundancy matrix
    Q = I - H: leaving out i gains r_i^2 / Q_ii, exchanging changes the readings by v and adds
    2 v'r + v'Qv), one error fewer, two wrong readings as one exchanged pair.

    Args:
        camera: the linearised camera; points are counted within its readings.
        seeds: explanations to start from.
        count: wanted.
        beam: explanations that are taken further at each level.
    """
    n = len(camera.readings)
    width = int(np.clip(PAIR_ROOM // n**2, 4, beam))
    known: dict[Hypothesis, float] = {}
    states = _work_out(camera, list(dict.fromkeys(seeds)))
    _note(known, zip(_score(camera, states).tolist(), states.explained, strict=True))
    best, waited = max(known.values()), 0
    for _ in range(LEVELS):
        grown = dict[Hypothesis, float]()
        _note(grown, _more(camera, states, 2 * width))
        _note(grown, _fewer(camera, states))
        fresh = [(score, h) for h, score in grown.items() if h not in known]
        if not fresh:
            break
        fresh.sort(key=_by_score)
        _note(known, fresh[: 4 * width])
        if fresh[0][0] > best + 1e-9:
            best, waited = fresh[0][0], 0
        else:
            waited += 1
            if waited == PATIENCE:
                break
        states = _work_out(camera, [h for _, h in fresh[:width]])
    return sorted(((score, h) for h, score in known.items()), key=_by_score)[:count]


def _by_score(entry: tuple[float, Hypothesis]) -> tuple[float, int, list[int]]:
    return -entry[0], entry[1].size, sorted(entry[1].touched)


def _note(known: dict[Hypothesis, float], entries: Iterable[tuple[float, Hypothesis]]) -> None:
    for score, hypothesis in entries:
        if np.isfinite(score):
            known.setdefault(hypothesis, score)


def _work_out(camera: LinearCamera, explained: Sequence[Hypothesis]) -> _States:
    n = len(camera.readings)
    mended = [h.mended(camera.readings, camera.sigma) for h in explained]
    readings = np.array([one for one, _ in mended]).reshape(-1, n)
    sigma = np.array([one for _, one in mended]).reshape(-1, n)
    kept = np.isfinite(readings)
    # The basis holds J over the deviation at its first place; one that moved keeps its reading's.
    misfit = np.where(kept, np.where(kept, readings, 0.0) - camera.fitted, 0.0) / camera.sigma
    basis = camera.basis * kept[..., None]
    normal = basis.swapaxes(1, 2) @ basis
    inverse = np.linalg.inv(normal + 1e-12 * np.eye(camera.evidence.parameters))
    spread = basis @ inverse
    residual = misfit - (spread @ (basis.swapaxes(1, 2) @ misfit[..., None]))[..., 0]
    return _States(
        explained,
        residual,
        basis,
        spread,
        kept,
        (residual**2).sum(axis=1),
        kept.sum(axis=1),
        np.linalg.slogdet(normal)[1],
        np.where(kept, np.log(sigma), 0.0).sum(axis=1),
    )


def _prior(camera: LinearCamera, explained: Sequence[Hypothesis]) -> Array:
    return np.array([h.log_prior(len(camera.readings), 0) for h in explained])


def _score(camera: LinearCamera, states: _States) -> Array:
    likelihood = camera.evidence.log_likelihood(
        states.chi2,
        states.kept,
        states.log_determinant,
        states.log_sigma,
        np.array([len(h.wrong) for h in states.explained]),
    )
    score = likelihood + _prior(camera, states.explained)
    return np.where(states.kept > camera.evidence.parameters, score, -np.inf)


def _more(camera: LinearCamera, states: _States, count: int) -> list[tuple[float, Hypothesis]]:
    """Return the best explanations with one wrong reading, or one exchanged pair, more."""
    n = len(camera.readings)
    redundancy = np.eye(n) * states.used[:, None] - states.spread @ states.basis.swapaxes(1, 2)
    own = np.einsum("bii->bi", redundancy)
    free = np.ones(own.shape, dtype=bool)
    for row, hypothesis in enumerate(states.explained):
        free[row, list(hypothesis.touched)] = False
    wrong = np.array([len(h.wrong) for h in states.explained])[:, None]
    prior = _prior(camera, states.explained)[:, None]
    usable = free & (own > TIED) & (states.kept[:, None] - 1 > camera.evidence.parameters)
    safe = np.where(usable, own, 1.0)
    left_out = camera.evidence.log_likelihood(
        np.maximum(states.chi2[:, None] - states.residual**2 / safe, 0.0),
        states.kept[:, None] - 1,
        states.log_determinant[:, None] + np.log(safe),
        states.log_sigma[:, None] - np.log(camera.sigma),
        wrong + 1,
    )
    left_out = np.where(usable, left_out + prior + log(WRONG_CHANCE), -np.inf)

    first, second = np.triu_indices(n, 1)
    change = camera.readings[second] - camera.readings[first]
    at_first, at_second = change / camera.sigma[first], -change / camera.sigma[second]
    squares = (
        states.chi2[:, None]
        + 2.0 * (at_first * states.residual[:, first] + at_second * states.residual[:, second])
        + at_first**2 * own[:, first]
        + at_second**2 * own[:, second]
        + 2.0 * at_first * at_second * redundancy[:, first, second]
    )
    exchanged = camera.evidence.log_likelihood(
        np.maximum(squares, 0.0),
        states.kept[:, None],
        states.log_determinant[:, None],
        states.log_sigma[:, None],
        wrong,
    )
    both = free[:, first] & free[:, second]
    exchanged = np.where(both, exchanged + prior + log_exchange(n), -np.inf)

    scores = np.concatenate([left_out, exchanged], axis=1)
    flat = np.argpartition(-scores, min(count, scores.size - 1), axis=None)[:count]
    grown = []
    for index in flat.tolist():
        row, column = divmod(index, scores.shape[1])
        base = states.explained[row]
        made = (
            base.with_wrong(column)
            if column < n
            else base.with_cycle((int(first[column - n]), int(second[column - n])))
        )
        grown.append((float(scores[row, column]), made))
    return grown


def _fewer(camera: LinearCamera, states: _States) -> list[tuple[float, Hypothesis]]:
    """Return explanations with one error fewer, or two wrong readings as an exchanged pair."""
    made: dict[Hypothesis, None] = {}
    for hypothesis in states.explained[:SHRUNK]:
        for point in sorted(hypothesis.wrong):
            made.setdefault(hypothesis.without(point))
        for cycle in sorted(hypothesis.cycles):
            made.setdefault(hypothesis.without(cycle))
        for pair in _likely_pairs(camera, sorted(hypothesis.wrong)):
            made.setdefault(hypothesis.with_cycle(pair))
    scored: list[tuple[float, Hypothesis]] = []
    every = list(made)
    for first in range(0, len(every), TOGETHER):
        worked = _work_out(camera, every[first : first + TOGETHER])
        scored += zip(_score(camera, worked).tolist(), worked.explained, strict=True)
    return scored


def _likely_pairs(camera: LinearCamera, wrong: list[int]) -> list[tuple[int, int]]:
    """Return the pairs of wrong readings that lie nearest where the other's should."""
    pairs = list(combinations(wrong, 2))
    if len(pairs) <= PAIRS:
        return pairs
    first, second = np.array(pairs).T
    off = np.maximum(
        np.abs(camera.readings[first] - camera.fitted[second]),
        np.abs(camera.readings[second] - camera.fitted[first]),
    )
    return [pairs[k] for k in np.argsort(off, kind="stable")[:PAIRS].tolist()]
