"""Packing: the most probable set and the probabilities beside all sets written down."""

from itertools import combinations
from math import exp

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.reconstruction.correspondence.set_packing import solve_set_packing

RESOURCES = 9


@st.composite
def problems(draw: st.DrawFn) -> tuple[list[tuple[int, ...]], list[float], dict[int, int]]:
    count = draw(st.integers(1, 9))
    one = st.sets(st.integers(0, RESOURCES - 1), min_size=1, max_size=4)
    columns = [tuple(sorted(draw(one))) for _ in range(count)]
    scores = [draw(st.floats(-2.0, 9.0)) for _ in range(count)]
    double = draw(st.sets(st.integers(0, RESOURCES - 1), max_size=2))
    return columns, scores, dict.fromkeys(double, 2)


def all_sets(
    columns: list[tuple[int, ...]], scores: list[float], room: dict[int, int]
) -> list[tuple[float, tuple[int, ...]]]:
    useful = [index for index, score in enumerate(scores) if score > 0.0]
    found = []
    for size in range(len(useful) + 1):
        for chosen in combinations(useful, size):
            used = [resource for index in chosen for resource in columns[index]]
            if all(used.count(r) <= room.get(r, 1) for r in used):
                found.append((sum(scores[index] for index in chosen), chosen))
    return found


@pytest.mark.slow
@given(problems())
@settings(max_examples=300, deadline=None)
def test_as_all_sets_written_down(
    problem: tuple[list[tuple[int, ...]], list[float], dict[int, int]],
) -> None:
    columns, scores, room = problem
    sets = all_sets(columns, scores, room)
    found = solve_set_packing(columns, scores, window=60.0, max_branches=100_000, capacity=room)
    assert found.cut == 0
    chosen = sum(scores[index] for index in found.chosen)
    assert chosen == pytest.approx(max(sets)[0], abs=1e-5)
    assert (pytest.approx(chosen), found.chosen) in sets
    total = sum(exp(score) for score, _ in sets)
    for index, error_probability in zip(found.chosen, found.error_probability, strict=True):
        without = sum(exp(score) for score, chosen in sets if index not in chosen)
        assert error_probability == pytest.approx(without / total, abs=1e-6)


@given(problems())
@settings(max_examples=100, deadline=None)
def test_too_many_branches_leave_nothing_sure_that_is_not(
    problem: tuple[list[tuple[int, ...]], list[float], dict[int, int]],
) -> None:
    """With one branch only, what comes near is bounded or doubted altogether."""
    columns, scores, room = problem
    exact = solve_set_packing(columns, scores, window=60.0, max_branches=100_000, capacity=room)
    short = solve_set_packing(columns, scores, window=60.0, max_branches=1, capacity=room)
    used = [resource for index in short.chosen for resource in columns[index]]
    assert all(used.count(r) <= room.get(r, 1) for r in used)
    true = dict(zip(exact.chosen, exact.error_probability, strict=True))
    for index, error_probability in zip(short.chosen, short.error_probability, strict=True):
        assert error_probability >= min(true.get(index, 1.0), 0.999) - 1e-6


def test_a_chain_of_many_columns_is_exact_by_programme_and_parts() -> None:
    """Columns i, i + 1: of 61 the odd ones do best; each even one is an alternative."""
    columns = [(index, index + 1) for index in range(61)]
    scores = [5.0 + (index % 2 == 0) for index in range(61)]
    found = solve_set_packing(columns, scores, window=12.0, max_branches=1_000)
    assert found.cut == 0
    assert found.chosen == tuple(range(0, 61, 2))
    assert 0.0 < max(found.error_probability) < 0.1


def test_nothing_to_choose() -> None:
    assert solve_set_packing([], [], 10.0, 10).chosen == ()
    assert solve_set_packing([(0,)], [-1.0], 10.0, 10).chosen == ()
    (error_probability,) = solve_set_packing([(0,)], [3.0], 10.0, 10).error_probability
    assert error_probability == pytest.approx(1.0 / (1.0 + exp(3.0)))
