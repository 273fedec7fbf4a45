"""Arrivals on the monotonic clock: exact, and within bounds where the host's clock was set."""

from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import hardware.genicam.buffer_timestamps
from hardware.genicam.buffer_timestamps import BufferTimestamps

OPENED_NS = 10**12
MAX_LEAD_NS = 10**18
"""Of the host's clock to its monotonic one."""

some_ns = st.integers(0, 10**9)


@settings(deadline=None)
@given(st.lists(st.tuples(some_ns, some_ns, st.integers(-(10**11), 10**11)), max_size=20))
def test_arrivals_are_exact_until_the_clock_is_set_and_bounded_then(
    steps: list[tuple[int, int, int]],
) -> None:
    """Each is found so long after the stream was empty, and taken so long after that."""
    host = SimpleNamespace(mono_ns=OPENED_NS, ahead_ns=MAX_LEAD_NS)
    clocks = SimpleNamespace(
        monotonic_ns=lambda: host.mono_ns, time_ns=lambda: host.mono_ns + host.ahead_ns
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hardware.genicam.buffer_timestamps, "time", clocks)
        arrivals = BufferTimestamps()
        for waited_ns, taken_after_ns, set_by_ns in steps:
            empty_ns = host.mono_ns
            arrivals.empty(empty_ns)
            arrival_ns = empty_ns + waited_ns
            wall_ns = arrival_ns + host.ahead_ns
            host.mono_ns = arrival_ns + taken_after_ns
            assert arrivals.of(wall_ns) == arrival_ns
            host.ahead_ns += set_by_ns
            assert empty_ns <= arrivals.of(wall_ns) <= host.mono_ns


def test_before_anything_was_empty_it_is_bounded_by_the_opening(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clocks = SimpleNamespace(monotonic_ns=lambda: OPENED_NS, time_ns=lambda: MAX_LEAD_NS)
    monkeypatch.setattr(hardware.genicam.buffer_timestamps, "time", clocks)
    arrivals = BufferTimestamps()
    clocks.monotonic_ns = lambda: OPENED_NS + 500
    assert arrivals.of(MAX_LEAD_NS - 10_000) == OPENED_NS
