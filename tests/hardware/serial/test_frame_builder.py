"""FrameBuilder: sequence numbers and times across losses and resets."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hardware.line_frame import FrameFlag, LineFrame
from hardware.serial.frame_builder import FrameBuilder
from hardware.serial.messages import NO_MARKER, Description, Lines, LinesFlag
from tests.hardware.serial.test_decoder import whole

DESCRIPTION = Description("bar", ("a", "b"), 4, 14.0, clock_hz=100_000_000, clock_bits=32)
STEP = 1_000_000  # ticks of 10 ms


def built(maker: FrameBuilder, number: int, ticks: int, arrival_ns: int) -> LineFrame:
    lines = whole(0).counts.reshape(2, 4)
    exposed = Lines(number % 2**32, ticks % 2**32, NO_MARKER, LinesFlag.NONE, 0, 0, lines)
    frame = maker.build(exposed, arrival_ns)
    assert frame is not None
    return frame


def test_numbers_count_on_over_their_turn() -> None:
    maker = FrameBuilder("bar", DESCRIPTION, 0)
    frames = [built(maker, 2**32 - 3 + n, n * STEP, n * 10_000_000) for n in (0, 1, 2, 3, 5, 6)]
    assert [frame.sequence for frame in frames] == [0, 1, 2, 3, 5, 6]
    assert [frame.flags for frame in frames] == [
        FrameFlag.NONE, FrameFlag.NONE, FrameFlag.NONE, FrameFlag.NONE, FrameFlag.OVERFLOW,
        FrameFlag.NONE,
    ]  # fmt: skip
    assert maker.lost == 1
    assert maker.clock.restarts == 0


def test_a_reset_that_only_the_numbers_show() -> None:
    """After a minute away the ticks of a reset clock of 43 s could be those of one that went on."""
    maker = FrameBuilder("bar", DESCRIPTION, 0)
    for number in range(100):
        last = built(maker, number, number * STEP, number * 10_000_000)
    back = built(maker, 0, 50_000_000, 61_000_000_000)
    assert maker.clock.restarts == 1
    assert (back.sequence, back.flags) == (100, FrameFlag.OVERFLOW)
    assert maker.lost == 0
    # Sixty seconds are over, and not those that the ticks would say.
    assert abs(back.exposure_device_ns - last.exposure_device_ns - 60_010_000_000) < 20_000_000


def test_a_marker_that_cannot_be_is_refused() -> None:
    maker = FrameBuilder("bar", DESCRIPTION, 2)
    lines = whole(0).counts.reshape(2, 4)
    assert maker.build(Lines(0, 0, 1, LinesFlag.NONE, 0, 0, lines), 0) is not None
    assert maker.build(Lines(1, STEP, 2, LinesFlag.NONE, 0, 0, lines), 10_000_000) is None
    assert maker.refused == 1


@pytest.mark.parametrize("first", [0, 1000])
@pytest.mark.parametrize("other", [{"clock_hz": 10_000_000}, {"clock_bits": 24}])
def test_a_device_that_comes_back_with_another_clock_is_timed_by_that(
    other: dict[str, Any], first: int
) -> None:
    """After ten seconds away; with its numbers from 0, or where they would be."""
    maker = FrameBuilder("bar", DESCRIPTION, 0)
    for number in range(1000):
        last = built(maker, number, number * STEP, number * 10_000_000)
    described = replace(DESCRIPTION, **other)
    maker.reconnect(described)
    step = described.clock_hz // 100
    frames = []
    for number in range(10):
        ticks = number * step % 2**described.clock_bits
        frames.append(built(maker, first + number, ticks, 20_000_000_000 + number * 10_000_000))
    assert maker.clock.restarts == 1
    assert [bool(frame.flags & FrameFlag.OVERFLOW) for frame in frames] == [True] + 9 * [False]
    times = np.array([frame.exposure_device_ns for frame in frames])
    assert np.diff(times) == pytest.approx(np.full(9, 10_000_000), abs=100)
    assert times[0] - last.exposure_device_ns == pytest.approx(10_010_000_000, abs=1000)


def test_a_device_that_comes_back_with_another_delay_is_timed_by_that() -> None:
    maker = FrameBuilder("bar", DESCRIPTION, 0)
    first = built(maker, 0, 0, 1_000_000_000)
    maker.reconnect(replace(DESCRIPTION, delay_us=250_000.0))
    second = built(maker, 1, 100 * STEP, 2_000_000_000)
    assert (second.flags, maker.clock.restarts) == (FrameFlag.NONE, 0)
    passed_ns = second.exposure_host_ns - first.exposure_host_ns
    assert passed_ns == pytest.approx(1_000_000_000 - 250_000_000, abs=50_000_000)


def test_exposure_of_a_device_that_comes_back_with_a_longer_delay_is_after_the_last() -> None:
    maker = FrameBuilder("bar", DESCRIPTION, 0)
    first = built(maker, 0, 0, 1_000_000_000)
    maker.reconnect(replace(DESCRIPTION, delay_us=250_000.0))
    second = built(maker, 1, STEP, 1_010_000_000)
    assert second.exposure_host_ns > first.exposure_host_ns


def test_exposure_that_is_sent_twice_is_refused() -> None:
    maker = FrameBuilder("bar", DESCRIPTION, 0)
    built(maker, 0, 0, 0)
    lines = whole(0).counts.reshape(2, 4)
    assert maker.build(Lines(0, 0, NO_MARKER, LinesFlag.NONE, 0, 0, lines), 10_000_000) is None
    assert (maker.refused, maker.irregular, maker.lost) == (1, 0, 0)


@pytest.mark.parametrize("kind", ["numbers", "same number", "ticks", "ticks back", "same ticks"])
def test_random_numbers_and_ticks_are_irregular_and_poison_no_counter(kind: str) -> None:
    """Of 500 exposures; losses of the regular ones after them are counted exactly."""
    maker = FrameBuilder("bar", DESCRIPTION, 0)
    random = np.random.default_rng(5)
    first = built(maker, 0, 0, 0)
    frames = [first]
    for number in range(1, 500):
        given, ticks = number, number * STEP
        if kind == "numbers":
            given = int(random.integers(2**32))
        elif kind == "same number":
            given = 0
        elif kind == "ticks":
            ticks = int(random.integers(2**32))
        elif kind == "ticks back":
            ticks = 2**31 - number * STEP
        else:
            ticks = 0
        frames.append(built(maker, given, ticks, number * 10_000_000))
    assert maker.lost == 0
    assert [frame.sequence for frame in frames] == list(range(500))
    device, host = (
        np.array([getattr(frame, f"exposure_{clock}_ns") for frame in frames])
        for clock in ("device", "host")
    )
    assert (np.diff(device) > 0).all()
    assert (np.diff(host) > 0).all()
    assert maker.irregular > 400
    # Regular again: the first one may begin anew, the others tell what is lost.
    built(maker, 1000, 1000 * STEP, 15_000_000_000)
    irregular, lost = maker.irregular, maker.lost
    built(maker, 1001, 1001 * STEP, 15_010_000_000)
    built(maker, 1004, 1004 * STEP, 15_040_000_000)
    assert (maker.irregular, maker.lost) == (irregular, lost + 2)
