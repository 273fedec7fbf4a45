"""RoundTripClock: asymmetric jitter and drift, its bound and uncertainty, clocks that are set."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from hardware.round_trip_clock import ClockOffset, RoundTripClock

TRIPS_HZ = 20.0


def trips(
    seconds: float,
    offset_s: float,
    rate: float,
    there_s: tuple[float, float],
    back_s: tuple[float, float],
    seed: int,
) -> tuple[RoundTripClock, int, float]:
    """Return a clock after trips, the time then, and the true offset then [ns].

    A way takes a shortest time and an exponential one of a mean more.
    """
    rng = np.random.default_rng(seed)
    clock = RoundTripClock()
    # A wall clock's times are large.
    start = 1_790_000_000_000_000_000

    def other(at_s: float) -> int:
        return start + round(1e9 * (at_s + offset_s + rate * at_s))

    sent_s = np.arange(0.0, seconds, 1.0 / TRIPS_HZ)
    for at_s in sent_s:
        there = there_s[0] + rng.exponential(there_s[1])
        work = rng.uniform(0.0, 1e-3)
        back = back_s[0] + rng.exponential(back_s[1])
        clock.add(
            start + round(1e9 * at_s),
            other(at_s + there),
            other(at_s + there + work),
            start + round(1e9 * (at_s + there + work + back)),
        )
    now_s = float(sent_s[-1])
    return clock, start + round(1e9 * now_s), 1e9 * (offset_s + rate * now_s)


def known(clock: RoundTripClock, at_ns: int) -> ClockOffset:
    offset = clock.offset(at_ns)
    assert offset is not None
    return offset


@given(
    offset_s=st.floats(-1e3, 1e3),
    rate=st.floats(-1e-4, 1e-4),
    shortest=st.tuples(st.floats(2e-5, 5e-4), st.floats(2e-5, 5e-4)),
    jitter=st.tuples(st.floats(1e-6, 2e-3), st.floats(1e-6, 2e-3)),
    seed=st.integers(0, 1000),
)
def test_it_is_within_its_bound_whatever_the_ways_take(
    offset_s: float,
    rate: float,
    shortest: tuple[float, float],
    jitter: tuple[float, float],
    seed: int,
) -> None:
    there, back = ((shortest[way], jitter[way]) for way in (0, 1))
    clock, now_ns, true_ns = trips(8.0, offset_s, rate, there, back, seed)
    found = known(clock, now_ns)
    error = abs(found.offset_ns - true_ns)
    assert error <= found.bound_ns + 1.0
    assert clock.restarts == 0
    # What the ways' difference does at their fastest, and some of the jitter.
    assert error <= 1e9 * (0.5 * abs(shortest[0] - shortest[1]) + 0.5 * max(jitter)) + 2e3


@pytest.mark.parametrize("rate", [0.0, 1e-4, -1e-4])
def test_equal_ways_with_unequal_jitter_are_no_bias(rate: float) -> None:
    """Jitter of 0.1 ms there and 1 ms back: a mean of trips would be off by 0.45 ms."""
    errors = []
    for seed in range(12):
        clock, now_ns, true_ns = trips(20.0, 3.0, rate, (1e-4, 1e-4), (1e-4, 1e-3), seed)
        found = known(clock, now_ns)
        errors.append(found.offset_ns - true_ns)
        assert found.rate == pytest.approx(-rate / (1.0 + rate), abs=5e-6)
    assert np.sqrt(np.mean(np.square(errors))) < 20e3


def test_its_uncertainty_is_that_of_ways_of_which_nothing_is_known() -> None:
    """Shortest ways of 0.2 ms together, each part of it as likely."""
    ratios = []
    for seed, part in enumerate(np.random.default_rng(1).uniform(size=24)):
        there, back = 2e-4 * part, 2e-4 * (1.0 - part)
        clock, now_ns, true_ns = trips(10.0, -2.0, 1e-4, (there, 5e-5), (back, 1e-4), seed)
        found = known(clock, now_ns)
        ratios.append((found.offset_ns - true_ns) / found.uncertainty_ns)
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.3


def test_its_uncertainty_grows_while_nothing_comes() -> None:
    clock, now_ns, _ = trips(10.0, 0.0, 0.0, (1e-4, 1e-5), (1e-4, 1e-5), 1)
    then = known(clock, now_ns + 60_000_000_000)
    assert then.uncertainty_ns > known(clock, now_ns).uncertainty_ns


def test_one_trip_is_the_middle_of_it() -> None:
    clock = RoundTripClock()
    assert clock.offset(0) is None
    clock.add(1_000, 501_500, 501_700, 2_000)
    found = known(clock, 1_500)
    assert found.offset_ns == pytest.approx(500_100, abs=1)
    assert found.bound_ns == pytest.approx(400.0, abs=1.0)


def test_a_clock_that_was_set_is_told_and_begun_anew() -> None:
    clock, now_ns, true_ns = trips(4.0, 1.0, 0.0, (1e-4, 1e-5), (1e-4, 1e-5), 2)
    ahead = round(true_ns) + 5_000_000_000
    clock.add(now_ns, now_ns + ahead + 100_000, now_ns + ahead + 100_000, now_ns + 200_000)
    assert clock.restarts == 1
    assert known(clock, now_ns).offset_ns == pytest.approx(ahead, abs=1000)


@pytest.mark.parametrize("times", [(2, 10, 11, 1), (1, 11, 10, 2)])
def test_times_that_go_back_are_refused(times: tuple[int, int, int, int]) -> None:
    with pytest.raises(InvalidParameter, match="go on"):
        RoundTripClock().add(*times)
