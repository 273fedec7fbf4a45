"""ResponseCollector: only complete responses are accepted, however fragmented."""

from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hardware.tcd1304.protocol import ELEMENTS, RESPONSE_BYTES
from hardware.tcd1304.response import InvalidResponse, Response, ResponseCollector

RAMP = (np.arange(ELEMENTS) % 4096).astype("<u2")
WHOLE = RAMP.tobytes()


def fed(data: bytes, cuts: list[int]) -> ResponseCollector:
    """A collector that got the data in pieces, at 0, 1, 2, ... ns."""
    collector = ResponseCollector()
    bounds = [0, *sorted(cuts), len(data)]
    for now_ns, (first, last) in enumerate(pairwise(bounds)):
        collector.feed(data[first:last], now_ns)
    return collector


CUTS = st.lists(st.integers(1, RESPONSE_BYTES - 1), max_size=8)


@given(CUTS)
def test_a_whole_answer_in_any_pieces(cuts: list[int]) -> None:
    collector = fed(WHOLE, cuts)
    answer = collector.silence()
    assert isinstance(answer, Response)
    np.testing.assert_array_equal(answer.counts, RAMP)
    assert answer.counts.dtype == np.uint16
    assert answer.first_byte_ns == 0
    assert collector.silence() is None


@given(st.integers(1, RESPONSE_BYTES - 1), CUTS)
def test_a_cut_answer_is_refused_and_the_next_one_taken(length: int, cuts: list[int]) -> None:
    collector = fed(WHOLE[:length], [cut for cut in cuts if cut < length])
    refused = collector.silence()
    assert isinstance(refused, InvalidResponse)
    assert refused.bytes == length
    assert refused.detail == f"{length} bytes came where an answer has 7388"
    collector.feed(WHOLE, 100)
    answer = collector.silence()
    assert isinstance(answer, Response)
    assert answer.first_byte_ns == 100
    np.testing.assert_array_equal(answer.counts, RAMP)


@given(st.binary(min_size=1, max_size=100), st.integers(0, RESPONSE_BYTES))
def test_surplus_bytes_anywhere_are_refused(surplus: bytes, where: int) -> None:
    refused = fed(WHOLE[:where] + surplus + WHOLE[where:], []).silence()
    assert isinstance(refused, InvalidResponse)
    assert refused.bytes == RESPONSE_BYTES + len(surplus)
    assert refused.detail == f"{refused.bytes} bytes came where an answer has 7388"


@given(st.integers(0, 50), st.integers(0, 50))
def test_one_byte_lost_and_one_gained_is_seen_by_the_counts(lost: int, gained: int) -> None:
    """All bytes between the two places are shifted by one: high and low bytes change places."""
    light = np.full(ELEMENTS, 0x0C1F, "<u2").tobytes()
    first, last = 2 * lost, RESPONSE_BYTES - 2 * gained
    shifted = light[:first] + light[first + 1 : last] + b"\x0c" + light[last:]
    assert len(shifted) == RESPONSE_BYTES
    refused = fed(shifted, []).silence()
    assert isinstance(refused, InvalidResponse)
    assert refused.detail.startswith(f"element {lost} of 3694 is {0x1F0C}")


@given(st.lists(st.one_of(st.binary(max_size=3000), st.none()), max_size=30))
def test_any_bytes_and_silences_never_raise_and_memory_is_bounded(
    events: list[bytes | None],
) -> None:
    collector = ResponseCollector()
    since = 0
    for event in events:
        if event is None:
            outcome = collector.silence()
            assert (outcome is None) == (since == 0)
            if isinstance(outcome, Response):
                assert since == RESPONSE_BYTES
            since = 0
        else:
            collector.feed(event, 0)
            since += len(event)
        assert collector.pending == since
        assert len(collector._buffer) <= RESPONSE_BYTES


def test_a_flood_is_counted_but_not_kept() -> None:
    collector = ResponseCollector()
    for _ in range(100):
        collector.feed(bytes(3000), 0)
    assert collector.pending == 300_000
    assert len(collector._buffer) == RESPONSE_BYTES
