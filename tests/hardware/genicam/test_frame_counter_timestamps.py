"""Numbers and times of a camera go on: over 16 bits, lost buffers, restarts and late arrivals."""

from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware.genicam.frame_counter import FrameCounter
from hardware.genicam.timestamps import ScanTimestamps


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
