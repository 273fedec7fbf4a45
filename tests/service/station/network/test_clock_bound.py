"""ClockBound: a deadline of another machine never ends later here than there."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.station.network.clock_bound import ClockBound

TRIPS = st.lists(
    st.tuples(st.floats(0.0, 5.0), st.floats(0.0, 0.5), st.floats(0.0, 0.5)),
    min_size=1,
    max_size=40,
)
"""Pause before a question, and the times that it and its answer take."""


@settings(max_examples=300)
@given(
    st.floats(-1e5, 1e5),
    st.floats(-4e-4, 4e-4),
    TRIPS,
    st.floats(0.0, 2.0),
    st.floats(0.0, 10.0),
)
def test_no_deadline_ends_later_here_than_there(
    offset_s: float,
    rate: float,
    trips: list[tuple[float, float, float]],
    valid_s: float,
    later_s: float,
) -> None:
    def there(here_s: float) -> float:
        return offset_s + here_s * (1.0 + rate)

    bound, now_s = ClockBound(), 1000.0
    for pause_s, out_s, back_s in trips:
        now_s += pause_s
        bound.add(now_s, there(now_s + out_s))
        now_s += out_s + back_s
    now_s += later_s
    due_there_s = there(now_s) + valid_s
    due_here_s = bound.local_s(due_there_s, now_s)
    # Rounding of numbers of this size; a nanosecond.
    assert there(due_here_s) <= due_there_s + 1e-9 * max(1.0, abs(due_there_s))


def test_what_it_errs_by_is_the_way_of_the_fastest_question() -> None:
    bound = ClockBound()
    for asked_s, out_s in ((10.0, 0.2), (10.5, 0.001), (11.0, 0.3)):
        bound.add(asked_s, asked_s + out_s + 50.0)
    assert bound.ahead_s(11.0) == pytest.approx(50.0 + 0.001, abs=1e-3)
    assert bound.local_s(61.5, 11.0) == pytest.approx(11.5, abs=3e-3)


def test_nobody_who_was_never_asked_lets_a_beam_go_on() -> None:
    bound = ClockBound()
    assert bound.local_s(1e9, 5.0) == -math.inf
    bound.add(1.0, 2.0)
    assert math.isfinite(bound.local_s(1e9, 5.0))
    bound.clear()
    assert bound.local_s(1e9, 5.0) == -math.inf
