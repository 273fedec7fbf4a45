"""The frame ring: bounded, in order, and counting what it drops."""

import threading
from collections import deque
from collections.abc import Sequence

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hardware.line_frame import LineFrame
from service.pipeline.threads import FrameRing

LINES = np.zeros((1, 64), np.uint16)


def frame(sequence: int) -> LineFrame:
    return LineFrame("d", sequence, 0, 0, None, LINES)


@given(st.integers(1, 8), st.lists(st.one_of(st.none(), st.integers(1, 6)), max_size=60))
def test_behaves_as_a_bounded_queue(capacity: int, steps: list[int | None]) -> None:
    """None puts a frame, a number takes up to so many; compared with a deque."""
    ring, model = FrameRing(capacity), deque[int]()
    put = dropped = 0
    for step in steps:
        if step is None:
            ring.put(frame(put))
            if len(model) == capacity:
                model.popleft()
                dropped += 1
            model.append(put)
            put += 1
        else:
            expected = [model.popleft() for _ in range(min(step, len(model)))]
            assert [taken.sequence for taken in ring.take(step)] == expected
        assert len(ring) == len(model)
    assert (ring.received, ring.dropped, ring.lost) == (put, dropped, 0)


def test_take_chosen_leaves_frames_without_an_answer_in_the_ring() -> None:
    ring = FrameRing(4)
    assert ring.take_chosen(3, lambda *_: [True]) == ([], [])
    for number in range(5):  # one too many
        ring.put(frame(number))
    shown: list[tuple[list[int], int]] = []

    def choose(frames: Sequence[LineFrame], waiting: int) -> list[str]:
        shown.append(([one.sequence for one in frames], waiting))
        return ["first", "second"][: len(frames)]

    taken, answers = ring.take_chosen(3, choose)
    assert ([one.sequence for one in taken], answers) == ([1, 2], ["first", "second"])
    assert (len(ring), ring.dropped) == (2, 1)
    assert [one.sequence for one in ring.take_chosen(3, choose)[0]] == [3, 4]
    assert shown == [([1, 2, 3], 1), ([3, 4], 0)]
    assert (ring.received, ring.lost, len(ring)) == (5, 0, 0)


@given(st.lists(st.integers(1, 5), max_size=30))
def test_counts_exposures_lost_before_it(gaps: list[int]) -> None:
    ring = FrameRing(100)
    sequence = 7
    ring.put(frame(sequence))
    for gap in gaps:
        sequence += gap
        ring.put(frame(sequence))
    assert ring.lost == sum(gap - 1 for gap in gaps)


def test_nothing_is_lost_or_doubled_between_threads() -> None:
    wake = threading.Event()
    ring = FrameRing(100_000)
    count = 20_000

    def produce() -> None:
        for sequence in range(count):
            ring.put(frame(sequence))
            wake.set()

    producer = threading.Thread(target=produce)
    producer.start()
    taken: list[int] = []
    while len(taken) < count:
        assert wake.wait(240.0)
        wake.clear()
        while batch := ring.take(64):
            taken.extend(item.sequence for item in batch)
    producer.join()
    assert taken == list(range(count))
