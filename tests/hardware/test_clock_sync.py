"""DeviceClock: accuracy with delayed arrivals, wrap-arounds, resets; HostClock: times that rise."""

from collections.abc import Iterator
from itertools import chain, repeat
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from hardware import clock_sync
from hardware.clock_sync import (
    BRACKET_NS,
    MAX_READS,
    SET_BACK_NS,
    DeviceClock,
    HostClock,
    host_clock_offset_ns,
)
from hardware.clock_sync_simulation import (
    CASES,
    MIN_DELAY_S,
    Array,
    SimulatedClock,
    arrivals,
    device_ticks,
    errors,
    map_ticks,
)


def simulated(
    case: SimulatedClock, seconds: float, seed: int, first: int = 0, bits: int = 32, **clock: Any
) -> tuple[DeviceClock, Array, Array]:
    """Return the clock, the exposures' true times, and the errors of its host times [s]."""
    true_s, arrived_s = arrivals(case, seconds, seed)
    made = DeviceClock(1_000_000, bits, **clock)
    shown = [(first + int(tick)) % 2**bits for tick in device_ticks(case, true_s)]
    ticks = np.array(shown, dtype=object)
    host_s, _ = map_ticks(made, ticks, arrived_s)
    return made, true_s, host_s - true_s - MIN_DELAY_S


@pytest.mark.parametrize("rate", [0.0, 5e-5, -1e-4, 1e-2])
@pytest.mark.parametrize(("jitter_s", "stalls_s"), [(1e-4, 0.0), (5e-4, 0.05)])
def test_late_arrivals_do_not_move_it(rate: float, jitter_s: float, stalls_s: float) -> None:
    case = SimulatedClock("", 500.0, jitter_s, rate, 1.0 if stalls_s else 0.0, stalls_s)
    clock, true_s, error_s = simulated(case, 12.0, 3)
    settled = true_s > 4.0
    rms = np.sqrt(np.mean(error_s[settled] ** 2))
    assert rms < 0.1 * jitter_s
    assert clock.rate == pytest.approx(-rate / (1.0 + rate), abs=2e-5)
    assert clock.restarts == 0


def test_its_uncertainty_is_that_of_its_errors() -> None:
    """Over seeds and jitters: neither far too small nor far too large."""
    ratios = []
    for seed, (rate_hz, jitter_s) in enumerate(
        [(500, 1e-4), (200, 1e-3), (100, 2e-3), (50, 5e-3)] * 3
    ):
        clock, true_s, error_s = simulated(SimulatedClock("", rate_hz, jitter_s, 3e-5), 8.0, seed)
        last = true_s > 6.0
        ratios.append(np.sqrt(np.mean(error_s[last] ** 2)) / (clock.uncertainty_ns * 1e-9))
    assert 0.2 < np.sqrt(np.mean(np.square(ratios))) < 1.5
    assert max(ratios) < 3.0


def test_a_known_delay_is_taken_off() -> None:
    case, delay_ns = SimulatedClock("", 500.0, 1e-5, 0.0), round(MIN_DELAY_S * 1e9)
    _, true_s, error_s = simulated(case, 4.0, 1, delay_ns=delay_ns)
    assert np.abs(error_s[true_s > 2.0] + MIN_DELAY_S).max() < 2e-5


@pytest.mark.parametrize("bits", [16, 18, 20, 24, 32, 64])
def test_ticks_begin_anew_and_the_clock_goes_on(bits: int) -> None:
    case = SimulatedClock("", 200.0, 1e-4, 0.0)
    clock, _, error_s = simulated(case, 3.0, 2, first=2**bits - 1000, bits=bits)
    assert clock.restarts == 0
    assert np.abs(error_s).max() < 0.002


def test_it_is_better_than_a_regression_where_arrivals_are_late() -> None:
    found = errors(CASES[1], seconds=14.0)
    assert found.hull_us < 0.1 * found.regression_us < found.arrival_us


@given(st.floats(0.1, 400.0), st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_turns_are_counted_over_a_pause(pause_s: float, first: int) -> None:
    """A clock of 32 bits at 100 MHz begins anew every 43 s."""
    clock = DeviceClock(100_000_000, 32)
    for number in range(5):
        clock.stamp((first + number * 1_000_000) % 2**32, 10**9 + number * 10_000_000)
    later_ns = round(pause_s * 1e9)
    before = clock.stamp((first + 5_000_000) % 2**32, 10**9 + 50_000_000)
    ticks = (first + 5_000_000 + later_ns // 10) % 2**32
    after = clock.stamp(ticks, 10**9 + 50_000_000 + later_ns)
    assert not after.restarted
    assert after.device_ns - before.device_ns == pytest.approx(later_ns, abs=20)


def test_a_backlog_after_a_stall_is_no_restart() -> None:
    """Three seconds of frames that arrive at once, late."""
    clock = DeviceClock(1_000_000, 32)
    for number in range(1000):
        arrival_ns = max(number * 5_000_000, 4_000_000_000 if number > 200 else 0)
        stamp = clock.stamp(number * 5000, arrival_ns + 10**9)
        assert not stamp.restarted
        assert stamp.host_ns <= arrival_ns + 10**9
    assert stamp.device_ns == 999 * 5_000_000


@pytest.mark.parametrize("bits", [32, 64])
@pytest.mark.parametrize("first", [0, 3_000_000, 90_000_000])
def test_a_clock_that_begins_anew_is_seen_and_counted_on(bits: int, first: int) -> None:
    """The device is reset after 20 s, and shows ``first`` 2 s later."""
    clock = DeviceClock(1_000_000, bits)
    for number in range(2000):
        last = clock.stamp(number * 10_000, 10**9 + number * 10_000_000)
    stamp = clock.stamp(first, 10**9 + 22 * 10**9)
    assert stamp.restarted
    assert clock.restarts == 1
    assert stamp.device_ns - last.device_ns == pytest.approx(2.01e9, abs=1e8)
    assert stamp.host_ns == 23 * 10**9
    following = clock.stamp(first + 10_000, 23 * 10**9 + 10_000_000)
    assert not following.restarted
    assert following.device_ns - stamp.device_ns == 10_000_000


def test_before_the_first_exposure_nothing_is_known() -> None:
    clock = DeviceClock(1_000_000)
    assert clock.uncertainty_ns == float("inf")
    stamp = clock.stamp(123, 456)
    assert (stamp.device_ns, stamp.host_ns, stamp.restarted) == (0, 456, False)


@pytest.mark.parametrize(("hz", "bits"), [(1_000_000, 16), (72_000_000, 24), (168_000_000, 24)])
def test_short_turns_are_not_counted_ahead(hz: int, bits: int) -> None:
    """Of 65, 233 and 100 ms; arrivals are late by 20 ms at most."""
    clock, rng = DeviceClock(hz, bits), np.random.default_rng(1)
    for number in range(300):
        late_ns = round(rng.uniform(1e6, 21e6))
        ticks = (5 * hz + number * hz // 100) % 2**bits
        stamp = clock.stamp(ticks, 10**10 + number * 10_000_000 + late_ns)
        assert stamp.device_ns == pytest.approx(number * 10_000_000, abs=1000 / hz * 1e9)
        assert not stamp.restarted


@pytest.mark.parametrize("period_ms", [5, 50])
def test_a_stall_longer_than_a_short_turn_is_over_when_it_is_over(period_ms: int) -> None:
    """A stall of 300 ms cannot be told from four turns of 65 ms; what follows is right again."""
    clock = DeviceClock(1_000_000, 16)
    for number in range(2000 // period_ms):
        sent_ms = number * period_ms
        arrival_ns = 10**9 + max(sent_ms, 1300 if sent_ms > 1000 else 0) * 1_000_000
        stamp = clock.stamp(sent_ms * 1000 % 2**16, arrival_ns)
        assert not stamp.restarted
        if sent_ms > 1350:
            assert stamp.host_ns == pytest.approx(arrival_ns, abs=2_000_000)
    # Ahead by the stall, to the next turn.
    assert stamp.device_ns == pytest.approx(sent_ms * 1_000_000, abs=333_000_000)


def test_turns_too_short_to_count_are_refused() -> None:
    with pytest.raises(InvalidParameter, match=r"16 bits at 72,000,000 .* every 0.91 ms"):
        DeviceClock(72_000_000, 16)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("slower", ["loses 4 ms", "2 ppm slower each second"])
def test_a_clock_that_falls_behind_is_said_to_be_uncertain(slower: str, seed: int) -> None:
    """At 20 s; a second later the error is known to be possible."""
    clock, rng = DeviceClock(1_000_000, 32), np.random.default_rng(seed)
    ratios = []
    for number in range(30 * 100):
        true_s = number / 100.0
        since_s = max(0.0, true_s - 20.0)
        behind_s = 1e-6 * since_s**2 if slower.startswith("2") else 0.004 * (since_s > 0.0)
        arrival_ns = round((1.0 + true_s + rng.exponential(1e-4)) * 1e9)
        stamp = clock.stamp(round((true_s * 1.00005 - behind_s) * 1e6), arrival_ns)
        if 18.0 < true_s < 20.0:
            assert clock.uncertainty_ns < 50_000
        if true_s > 22.0:
            ratios.append(abs(stamp.host_ns - (1.0 + true_s) * 1e9) / clock.uncertainty_ns)
    assert 0.3 < max(ratios) < 3.0


def test_another_clock_goes_on_from_where_the_first_was() -> None:
    clock = DeviceClock(1_000_000, 32, delay_ns=5)
    for number in range(100):
        last = clock.stamp(number * 10_000, 10**9 + number * 10_000_000)
    assert not clock.reconfigure(1_000_000, 32, 7, 2 * 10**9)  # only its delay
    assert clock.stamp(1_000_000, 2 * 10**9).host_ns == 2 * 10**9 - 7
    assert clock.reconfigure(10_000_000, 24, 0, 2_500_000_000)
    stamps = [
        clock.stamp(77 + number * 100_000, 2_500_000_000 + number * 10_000_000)
        for number in range(100)
    ]
    assert stamps[0].device_ns - last.device_ns == pytest.approx(510_000_000, abs=1000)
    assert stamps[-1].device_ns - stamps[0].device_ns == 990_000_000
    assert clock.restarts == 1


class BusyClocks:
    """Two clocks of a host; before each of their reads the thread waits for a time."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, waits_ns: Iterator[int]) -> None:
        self.now_ns, self.offset_ns, self.reads = 10**12, 10**18, 0
        self._waits_ns = waits_ns
        monkeypatch.setattr(clock_sync, "time", self)

    def monotonic_ns(self) -> int:
        self.now_ns += next(self._waits_ns)
        self.reads += 1
        return self.now_ns

    def time_ns(self) -> int:
        return self.monotonic_ns() + self.offset_ns


def test_offset_of_clocks_read_at_once_takes_one_bracket(monkeypatch: pytest.MonkeyPatch) -> None:
    clocks = BusyClocks(monkeypatch, repeat(50))
    assert host_clock_offset_ns() == clocks.offset_ns
    assert clocks.reads == 3


@pytest.mark.parametrize("place", [0, 1, 2, 3])
def test_offset_after_a_wait_between_the_reads_is_that_of_a_narrow_bracket(
    monkeypatch: pytest.MonkeyPatch, place: int
) -> None:
    waits = [50] * place + [20_000_000]
    clocks = BusyClocks(monkeypatch, chain(waits, repeat(50)))
    assert abs(host_clock_offset_ns() - clocks.offset_ns) <= BRACKET_NS // 2
    assert clocks.reads == (6 if place in (1, 2) else 3)


def test_offset_of_a_host_that_is_always_busy_is_that_of_the_narrowest_bracket(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    waits = [10_000_000] * 3 * (MAX_READS - 2) + [10_000_000, 30_000, 40_000]
    clocks = BusyClocks(monkeypatch, chain(waits, repeat(10_000_000)))
    assert abs(host_clock_offset_ns() - clocks.offset_ns) <= 35_000
    assert clocks.reads == 3 * MAX_READS


def test_host_times_rise_over_busy_clocks_and_small_steps_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    random = np.random.default_rng(8)
    waits = (int(wait) for wait in random.choice([50, 40_000, 20_000_000], 100_000))
    clocks, host = BusyClocks(monkeypatch, waits), HostClock()
    found = []
    for number in range(400):
        clocks.offset_ns -= 900_000_000 * (number == 200)
        found.append(host.convert(10**12 + number // 2 * 1_000_000))
    for times in zip(*found, strict=True):
        assert (np.diff(times) > 0).all()


def test_host_times_follow_a_clock_that_was_set_back(monkeypatch: pytest.MonkeyPatch) -> None:
    clocks, host = BusyClocks(monkeypatch, repeat(50)), HostClock()
    _, before_ns = host.convert(10**12)
    clocks.offset_ns -= 2 * SET_BACK_NS
    _, after_ns = host.convert(10**12 + 1_000_000)
    assert after_ns - before_ns == 1_000_000 - 2 * SET_BACK_NS
    assert host.convert(10**12 + 2_000_000)[1] == after_ns + 1_000_000
