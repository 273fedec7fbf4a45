"""SharedBlockRing: round trip of blocks, and refusal where it is full."""

import os
from dataclasses import replace

from hypothesis import given, settings
from hypothesis import strategies as st

from hardware.recording.layout import Losses
from hardware.recording.writer_process.shared_ring import RingShape, SharedBlockRing, make_memory
from tests.hardware.recording.blocks import PIXELS, SENSORS, assert_same_block, block

SHAPE = RingShape(size=64 * 400, sensors=SENSORS, pixels=PIXELS, lines=True)


@settings(max_examples=60, deadline=None)
@given(
    steps=st.lists(st.tuples(st.integers(1, 60), st.booleans()), max_size=40),
    lines=st.booleans(),
)
def test_blocks_come_out_as_they_went_in(steps: list[tuple[int, bool]], lines: bool) -> None:
    shape = replace(SHAPE, lines=lines)
    memory = make_memory(shape.size)
    try:
        put, take = SharedBlockRing(memory, shape), SharedBlockRing(memory, shape)
    finally:
        os.close(memory)
    waiting, first = [], 0

    for size, taken in steps:
        one, losses = block(first, size), Losses(first, size, 3)
        if put.put(one.rows, list(one.lines), one.peaks, one.points, losses):
            waiting.append((one, losses))
            first += size
        else:
            # Refused only where it may be: nothing is lost that would have fitted an empty ring.
            needed = shape.sections(size, len(one.peaks), len(one.points))[-1][0]
            assert put.head - put.tail + 2 * needed > shape.size
        if taken:
            for (found, found_losses), (expected, lost) in zip(
                take.take(put.head), waiting, strict=True
            ):
                expected = expected if lines else replace(expected, lines=None)
                assert_same_block(found, expected)
                assert found_losses == lost
            waiting.clear()
            put.tail = take.tail
            assert put.tail == put.head


def test_what_is_not_taken_is_not_written_over() -> None:
    memory = make_memory(SHAPE.size)
    put, take = SharedBlockRing(memory, SHAPE), SharedBlockRing(memory, SHAPE)
    os.close(memory)
    one = block(0, 40)
    count = 0
    while put.put(one.rows, list(one.lines), one.peaks, one.points, Losses(count)):
        count += 1
    assert 2 <= count <= SHAPE.size // SHAPE.sections(40, len(one.peaks), len(one.points))[-1][0]
    other = block(1000, 40)
    assert not put.put(other.rows, list(other.lines), other.peaks, other.points, Losses())
    for number, (found, losses) in enumerate(take.take(put.head)):
        assert_same_block(found, one)
        assert losses == Losses(number)
    assert take.tail == put.head
