"""The log of a stream's messages, against a plain list of all that ever came."""

from hypothesis import given
from hypothesis import strategies as st

from service.protocols.stream.message_log import StreamLog


def append(log: StreamLog, count: int) -> None:
    """Append a batch of frames, or for 0 a message that is no frame."""
    log._append(max(count, 1), lambda *_: [], frames=count > 0, releases=())


@given(
    capacity=st.integers(1, 200),
    counts=st.lists(st.integers(0, 12), max_size=300),
    places=st.lists(st.floats(0.0, 1.1), min_size=1, max_size=10),
    limit=st.integers(1, 70),
)
def test_entries_since_a_number_are_the_oldest_that_are_kept_behind_it(
    capacity: int, counts: list[int], places: list[float], limit: int
) -> None:
    log = StreamLog(capacity)
    sizes = [max(count, 1) for count in counts]
    for count in counts:
        append(log, count)
    kept = len(sizes)
    while kept > 1 and sum(sizes[-kept:]) > capacity:
        kept -= 1
    firsts = [sum(sizes[:index]) for index in range(len(sizes))][len(sizes) - kept :]
    ends = [first + size for first, size in zip(firsts, sizes[len(sizes) - kept :], strict=True)]
    assert log.next == sum(sizes)
    assert log.message_count == sum(sizes[len(sizes) - kept :])
    assert log.oldest == (firsts[0] if firsts else log.next)
    for place in places:
        number = int(place * log.next)
        behind = [first for first, end in zip(firsts, ends, strict=True) if end > number]
        assert [entry.first for entry in log.since(number, limit)] == behind[:limit]
