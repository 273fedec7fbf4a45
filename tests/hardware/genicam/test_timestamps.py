"""Timestamps and frame numbers: 16-bit wrap, lost buffers, resets, clock adjustments."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import hardware.clock_sync
import hardware.genicam.timestamps
from hardware.genicam.timestamps import BufferTimestamps, FrameCounter, ScanTimestamps


@settings(deadline=None)
@given(st.integers(1, 65535), st.lists(st.integers(1, 30_000), max_size=30))
def test_16_bit_numbers_are_counted_on(first: int, steps: list[int]) -> None:
    """From 65535 they go to 1: zero is never sent."""
    numbering = FrameCounter()
    assert numbering.next(first) == 0
    true = first
    for step in steps:
        true += step
        assert numbering.next((true - 1) % 65535 + 1) == true - first
    assert numbering.lost == sum(steps) - len(steps)
    assert numbering.restarts == 0


@settings(deadline=None)
@given(st.integers(70_000, 2**60), st.lists(st.integers(1, 2**40), max_size=10))
def test_64_bit_numbers_are_counted_on(first: int, steps: list[int]) -> None:
    numbering = FrameCounter()
    assert numbering.next(first) == 0
    true = first
    for step in steps:
        true += step
        assert numbering.next(true) == true - first


def test_a_camera_that_began_anew_is_counted_on_and_how_often_it_did() -> None:
    numbering = FrameCounter()
    assert [numbering.next(n) for n in (500, 501, 1, 2)] == [0, 1, 2, 3]
    assert numbering.restarts == 1
    numbering.restart()
    assert [numbering.next(n) for n in (9000, 9002)] == [4, 6]
    assert (numbering.lost, numbering.restarts) == (1, 2)


def run(camera: list[int], arrival: list[int]) -> tuple[list[int], list[int], ScanTimestamps]:
    times = ScanTimestamps()
    lines = []
    for camera_ns, arrival_ns in zip(camera, arrival, strict=True):
        times.buffer(camera_ns, arrival_ns)
        lines.append(times.line(1000))
    return [line[0] for line in lines], [line[1] for line in lines], times


def test_late_arrivals_do_not_move_the_host_time() -> None:
    """3000 buffers at 1 kHz: delays of 0.3 ms and an exponential tail, clocks 20 ppm apart."""
    random = np.random.default_rng(5)
    true = np.arange(3000) * 1_000_000 + 10**15
    camera = ((true - 10**15) * (1 + 20e-6)).astype(np.int64) + 7 * 10**9
    delay = 300_000 + random.exponential(2e6, 3000)
    device, host, _ = run(camera.tolist(), (true + delay).astype(np.int64).tolist())
    assert np.diff(device).tolist() == np.diff(camera).tolist()
    error = np.array(host) - true - 300_000 - 1000
    assert abs(error[500:]).max() < 200_000  # of delays of 2 ms on the mean
    assert (np.diff(host) >= 0).all()


def test_a_restarted_clock_goes_on_by_the_hosts() -> None:
    camera = [5_000_000_000, 5_001_000_000, 10_000, 1_010_000]
    arrival = [10**15 + ns for ns in (0, 1_000_000, 500_000_000, 501_000_000)]
    device, host, times = run(camera, arrival)
    assert times.restarts == 1
    assert np.diff(device).tolist() == [1_000_000, 499_000_000, 1_000_000]
    np.testing.assert_allclose(np.array(host) - 1000, arrival, atol=1, rtol=0)


@settings(deadline=None)
@given(st.lists(st.tuples(st.integers(0, 2**40), st.integers(0, 2**40)), min_size=1, max_size=30))
def test_times_never_go_back_whatever_comes(buffers: list[tuple[int, int]]) -> None:
    device, host, _ = run([b[0] for b in buffers], [b[1] for b in buffers])
    assert all(a < b for a, b in pairwise(device))
    assert all(a <= b for a, b in pairwise(host))


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
        for module in (hardware.genicam.timestamps, hardware.clock_sync):
            patch.setattr(module, "time", clocks)
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
    for module in (hardware.genicam.timestamps, hardware.clock_sync):
        monkeypatch.setattr(module, "time", clocks)
    arrivals = BufferTimestamps()
    clocks.monotonic_ns = lambda: OPENED_NS + 500
    assert arrivals.of(MAX_LEAD_NS - 10_000) == OPENED_NS
