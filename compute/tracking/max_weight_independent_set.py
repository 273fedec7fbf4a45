"""Maximum-weight set of candidate tracks of which no two share a peak."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MAX_ROUNDS: Final = 50


def max_weight_independent_set(score: Array, conflict: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Choose sequences without conflicts with a large sum of scores, of C.

    The best first, then as long as that adds up to more: one that is left out for those taken that
    it is in conflict with, or several that are left out for the one that keeps them out. A ghost of
    two markers may be likelier than either of them; it is not likelier than both.

    Args:
        score: log likelihood ratios, above 0, shape (C,).
        conflict: symmetric, none with itself, shape (C, C).
    """
    selected = greedy_independent_set(score, conflict)
    for _ in range(MAX_ROUNDS):
        if not (
            _one_for_all(score, conflict, selected) or _several_for_one(score, conflict, selected)
        ):
            break
    return selected


def greedy_independent_set(score: Array, conflict: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Choose sequences by falling score that are in conflict with none chosen before, of C.

    Args:
        score: log likelihood ratios, shape (C,).
        conflict: symmetric, shape (C, C).
    """
    selected = np.zeros(len(score), dtype=np.bool_)
    for index in np.argsort(-score, kind="stable").tolist():
        selected[index] = not (conflict[index] & selected).any()
    return selected


def best_alternatives(
    score: Array, conflict: NDArray[np.bool_], selected: NDArray[np.bool_]
) -> Array:
    """Return a bound on the score of alternatives to each chosen sequence, shape (C,).

    One that is left out, less all others that are taken and in conflict with it. 0 for those that
    are not taken.

    Args:
        score: as of ``max_weight_independent_set``.
        conflict: as of ``max_weight_independent_set``.
        selected: what that returned.
    """
    own_score = np.where(selected, score, 0.0)
    # Of each that is left out (columns), without this one that is taken (rows).
    value = score - conflict @ own_score + own_score[:, None]
    possible = conflict & selected[:, None] & ~selected
    best: Array = np.where(possible, value, 0.0).max(axis=1, initial=0.0)
    return best


def _one_for_all(score: Array, conflict: NDArray[np.bool_], selected: NDArray[np.bool_]) -> bool:
    gain = np.where(selected, -np.inf, score - conflict @ np.where(selected, score, 0.0))
    best = int(gain.argmax()) if len(gain) else 0
    if len(gain) == 0 or not gain[best] > 0.0:
        return False
    selected[conflict[best]] = False
    selected[best] = True
    return True


def _several_for_one(
    score: Array, conflict: NDArray[np.bool_], selected: NDArray[np.bool_]
) -> bool:
    blockers = (conflict & selected[:, None]).sum(axis=0)
    changed = False
    for one in np.flatnonzero(selected).tolist():
        waiting = np.flatnonzero(conflict[one] & ~selected & (blockers == 1))
        waiting = waiting[np.argsort(-score[waiting], kind="stable")]
        several: list[int] = []
        for index in waiting.tolist():
            if not conflict[index, several].any():
                several.append(index)
        if score[several].sum() > score[one]:
            selected[one] = False
            selected[several] = True
            blockers = (conflict & selected[:, None]).sum(axis=0)
            changed = True
    return changed
