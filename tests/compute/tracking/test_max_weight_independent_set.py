"""The set of sequences that do not have the same peaks, beside all sets that there are."""

from itertools import combinations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from compute.tracking.max_weight_independent_set import (
    best_alternatives,
    max_weight_independent_set,
)

Array = NDArray[np.float64]


def graph(links: list[tuple[int, int]], count: int) -> NDArray[np.bool_]:
    conflict = np.zeros((count, count), dtype=np.bool_)
    for one, two in links:
        if one != two and max(one, two) < count:
            conflict[one, two] = conflict[two, one] = True
    return conflict


def best_of_all(score: Array, conflict: NDArray[np.bool_]) -> float:
    count = len(score)
    return max(
        float(score[list(some)].sum())
        for size in range(count + 1)
        for some in combinations(range(count), size)
        if not conflict[np.ix_(some, some)].any()
    )


def test_a_ghost_is_not_likelier_than_its_two_markers() -> None:
    score = np.array([5.0, 3.0, 3.0])
    conflict = graph([(0, 1), (0, 2)], 3)
    taken = max_weight_independent_set(score, conflict)
    assert taken.tolist() == [False, True, True]
    # In the place of either marker the ghost would cost the other one.
    assert best_alternatives(score, conflict, taken).tolist() == [0.0, 2.0, 2.0]
    alone = max_weight_independent_set(score[:2], conflict[:2, :2])
    assert alone.tolist() == [True, False]
    assert best_alternatives(score[:2], conflict[:2, :2], alone).tolist() == [3.0, 0.0]


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.floats(0.1, 100.0), min_size=1, max_size=7),
    st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=12),
)
def test_no_two_of_the_set_are_in_conflict_and_nothing_can_be_added(
    values: list[float], links: list[tuple[int, int]]
) -> None:
    score, conflict = np.array(values), graph(links, len(values))
    taken = max_weight_independent_set(score, conflict)
    assert not conflict[np.ix_(taken, taken)].any()
    assert ((conflict & taken).any(axis=1) | taken).all()
    # Half of the best at least: no single one that is left out is worth what keeps it out.
    out = np.flatnonzero(~taken)
    assert all(score[one] <= score[taken & conflict[one]].sum() + 1e-9 for one in out)
    assert score[taken].sum() <= best_of_all(score, conflict) + 1e-9


def test_mostly_the_best_there_is() -> None:
    rng = np.random.default_rng(8)
    found = []
    for _ in range(40):
        score = rng.uniform(1.0, 10.0, 8)
        conflict = np.triu(rng.random((8, 8)) < 0.3, 1)
        conflict |= conflict.T
        found.append(
            score[max_weight_independent_set(score, conflict)].sum() / best_of_all(score, conflict)
        )
    assert np.mean(found) > 0.97
