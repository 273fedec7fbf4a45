"""FusionAssembler: order, waiting, late and lost frames, bars that go and come."""

import numpy as np
import pytest

from hardware.line_frame import FrameFlag
from service.pipeline.fusion.assembler import FusionAssembler
from service.pipeline.fusion.fused_frame import FusedFrame, join_peaks
from tests.oracles.two_bars import course, read, sensors
from tests.service.pipeline.fusion.two_bars import PERIOD_NS, START_NS, bar_frame

WAIT_S = 0.05
DELAY_NS = 700_000


def assembler() -> FusionAssembler:
    made = FusionAssembler("hall", [4, 4], WAIT_S, 0.0)
    for bar in (0, 1):
        made.set_away(bar, away=False)
    return made


def feed(made: FusionAssembler, bar: int, numbers: range, arrived_s: float = 0.0) -> None:
    for number in numbers:
        made.add(bar, bar_frame(bar, number * PERIOD_NS + bar * DELAY_NS, arrived_s))


def expected_px(frame: FusedFrame) -> np.ndarray:
    at_s = 1e-9 * (frame.exposure_host_ns - START_NS)
    return read(sensors(), course(np.array([at_s]), 500.0))[0]


def test_frames_have_both_bars_readings_at_the_first_ones_times() -> None:
    made = assembler()
    feed(made, 0, range(6))
    feed(made, 1, range(6))
    frames = made.take(0.0)
    # The last one lacks an exposure behind it.
    assert [frame.exposure_host_ns - START_NS for frame in frames] == [
        number * PERIOD_NS for number in range(5)
    ]
    assert [frame.sequence for frame in frames] == list(range(5))
    for frame in frames[1:]:
        np.testing.assert_allclose(frame.peaks.position_px[:, 0], expected_px(frame), atol=1e-4)
        np.testing.assert_array_equal(frame.bar_of_sensor, [-1] * 4 + [0] * 4)
    assert np.abs(frames[2].rates.rate_px_s[4:, 0]).max() > 100.0
    np.testing.assert_array_equal(frames[2].rates.rate_px_s[:4], 0.0)


def test_a_frame_waits_for_so_long_and_goes_on_without() -> None:
    made = assembler()
    feed(made, 1, range(2))
    feed(made, 0, range(4), arrived_s=10.0)
    assert len(made.take(10.0)) == 1
    assert made.due_s() == pytest.approx(10.0 + WAIT_S)
    late = made.take(10.0 + WAIT_S)
    assert [frame.sequence for frame in late] == [1, 2, 3]
    seen = [np.isfinite(frame.peaks.position_px[:, 0]).sum() for frame in late]
    # Along the line of the last two, and then they are too long ago.
    assert seen == [8, 8, 4]
    np.testing.assert_array_equal(late[2].bar_of_sensor, -1)
    # What comes too late is used for later frames only.
    feed(made, 1, range(2, 8), arrived_s=11.0)
    assert made.take(11.0) == []
    feed(made, 0, range(4, 6), arrived_s=11.0)
    assert [frame.sequence for frame in made.take(11.0)] == [4, 5]


def test_a_bar_that_is_away_is_left_out_and_taken_in_again() -> None:
    made = assembler()
    feed(made, 0, range(3))
    feed(made, 1, range(2))
    made.take(0.0)
    made.set_away(1, away=True)
    alone = made.take(0.0)
    assert len(alone) == 2
    assert np.isfinite(alone[-1].peaks.position_px[:, 0]).sum() == 4
    feed(made, 1, range(3, 6))
    made.set_away(1, away=False)
    feed(made, 1, range(10, 14))
    feed(made, 0, range(10, 13))
    together = made.take(0.0)
    assert np.isfinite(together[-1].peaks.position_px[:, 0]).all()


def test_without_the_first_bar_the_next_gives_the_times() -> None:
    made = assembler()
    feed(made, 0, range(4))
    feed(made, 1, range(4))
    before = made.take(0.0)
    made.set_away(0, away=True)
    feed(made, 1, range(4, 8))
    alone = made.take(0.0)
    assert [frame.exposure_host_ns - START_NS for frame in alone] == [
        number * PERIOD_NS + DELAY_NS for number in range(4, 8)
    ]
    assert {frame.reference for frame in before} == {0}
    assert {frame.reference for frame in alone} == {1}
    made.set_away(0, away=False)
    feed(made, 0, range(6, 12))
    feed(made, 1, range(8, 12))
    back = made.take(0.0)
    times = [frame.exposure_host_ns for frame in (*before, *alone, *back)]
    # No earlier than those before, though its frames are.
    assert times == sorted(set(times))
    assert {frame.reference for frame in back} == {0}


def test_strobed_markers_are_apart_and_flags_are_passed_on() -> None:
    made = assembler()
    for number in range(8):
        for bar in (0, 1):
            frame = bar_frame(bar, number * PERIOD_NS + bar * DELAY_NS, 0.0, marker=number % 2)
            made.add(bar, frame)
    frames = made.take(0.0)
    assert [frame.marker for frame in frames] == [0, 1, 0, 1, 0, 1]
    for frame in frames[2:]:
        np.testing.assert_allclose(frame.peaks.position_px[:, 0], expected_px(frame), atol=1e-3)
        assert frame.flags is FrameFlag.NONE


def test_peaks_of_several_frames_are_joined_scan_by_scan() -> None:
    made = assembler()
    feed(made, 0, range(4))
    feed(made, 1, range(4))
    frames = made.take(0.0)
    joined = join_peaks(frames)
    assert len(joined) == 8 * len(frames)
    np.testing.assert_array_equal(joined.position_px[8:16], frames[1].peaks.position_px)


def test_readings_that_are_not_there_have_no_peak() -> None:
    made = assembler()
    feed(made, 0, range(4))
    for number in range(4):
        hidden = bar_frame(1, number * PERIOD_NS + DELAY_NS, 0.0)
        hidden.peaks.position_px[1] = np.nan
        hidden.peaks.count[1] = 0
        made.add(1, hidden)
    frame = made.take(0.0)[1]
    np.testing.assert_array_equal(frame.peaks.count, [1, 1, 1, 1, 1, 0, 1, 1])
    assert np.isnan(frame.peaks.position_px[5]).all()
    assert frame.peaks.flags[5, 0] == 0
