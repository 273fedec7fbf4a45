"""Latency by stage: of one frame a second, whole from its exposure to the streams."""

import time

import numpy as np
import pytest

from hardware.line_frame import LineFrame
from service.pipeline.stage_latency import STAGES, StageLatency
from service.pipeline.threads import FrameRing

NO_LINES = np.empty((0, 0), np.uint16)
MS = 1_000_000


def frame(sequence: int, exposure_ns: int) -> LineFrame:
    return LineFrame("sim", sequence, exposure_ns, exposure_ns, None, NO_LINES)


@pytest.fixture
def ring() -> FrameRing:
    return FrameRing(10)


def test_the_first_frame_put_in_after_the_request_is_timed(
    ring: FrameRing, monkeypatch: pytest.MonkeyPatch
) -> None:
    stages = StageLatency(ring)
    now = 1_000_000 * MS
    monkeypatch.setattr(time, "time_ns", lambda: now)
    ring.put(frame(6, 0))
    assert not stages.sampled(ring.take(5), 0.0)
    ring.put(frame(7, now - 3 * MS))
    now += MS  # a frame behind it
    ring.put(frame(8, now - 3 * MS))
    batch = ring.take(5)
    assert stages.sampled(batch, 0.1)
    now = (1_000_000 + 20) * MS
    stages.count(batch, (1_000_000 + 5) * MS, (1_000_000 + 12) * MS)
    count, sums = stages.sums()
    assert count == 1
    assert tuple(sums) == STAGES
    assert tuple(sums.values()) == pytest.approx((0.003, 0.005, 0.007, 0.008))


def test_one_frame_a_second_is_timed(ring: FrameRing) -> None:
    stages = StageLatency(ring)
    for sequence in range(5_000):
        ring.put(frame(sequence, time.time_ns()))
        batch = ring.take(1)
        now_s = sequence * 1e-3
        if now_s >= stages.due_s and stages.sampled(batch, now_s):
            stages.count(batch, time.time_ns(), time.time_ns())
    assert stages.sums()[0] == 5


def test_a_sampled_frame_that_was_dropped_is_replaced_by_another(ring: FrameRing) -> None:
    stages = StageLatency(ring)
    ring.put(frame(0, 0))
    stages.sampled(ring.take(1), 0.0)
    for sequence in range(1, 20):  # the first of them are pushed out
        ring.put(frame(sequence, 0))
    assert not stages.sampled(ring.take(10), 0.5)
    ring.put(frame(20, 0))
    assert not stages.sampled(ring.take(10), 1.5)
    ring.put(frame(21, 0))
    assert stages.sampled(ring.take(10), 1.6)


def test_a_clock_that_was_set_back_makes_no_negative_time(ring: FrameRing) -> None:
    stages = StageLatency(ring)
    ring.request_sample()
    ring.put(frame(0, time.time_ns() + 10**12))
    batch = ring.take(1)
    assert stages.sampled(batch, 0.0)
    stages.count(batch, time.time_ns(), time.time_ns())
    assert min(stages.sums()[1].values()) == 0.0
