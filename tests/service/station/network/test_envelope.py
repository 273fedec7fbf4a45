"""Envelopes: whatever is packed comes back; what is missing is counted; other bytes are refused."""

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.station.network.envelope import (
    ROOM,
    Envelope,
    NotAnEnvelope,
    Reassembly,
    pack,
    unpack,
)

MESSAGES = st.lists(st.binary(max_size=300), max_size=6).map(tuple)


def received(reader: Reassembly, parts: list[bytes]) -> tuple[int, list[bytes]]:
    """What a reader counts as missing, and what it has."""
    missed, messages = 0, []
    for part in parts:
        one, found = reader.take(unpack(part))
        missed += one
        messages += list(found)
    return missed, messages


@settings(max_examples=80)
@given(
    MESSAGES,
    st.integers(0, 2**40),
    st.floats(0.0, 1e9),
    st.integers(ROOM + 64, 1200),
    st.booleans(),
)
def test_messages_come_back_in_whatever_parts(
    messages: tuple[bytes, ...], number: int, sent_s: float, limit: int, compressed: bool
) -> None:
    parts = pack(Envelope("one", number, sent_s, messages), limit, compressed=compressed)
    assert all(len(part) <= limit for part in parts)
    assert [unpack(part).number for part in parts] == list(range(number, number + len(parts)))
    assert {unpack(part).sent_s for part in parts} == {sent_s}
    assert received(Reassembly(), parts) == (0, list(messages))


@settings(max_examples=80)
@given(st.data())
def test_each_message_comes_whole_or_not_at_all_and_what_is_missing_is_counted(
    data: st.DataObject,
) -> None:
    sent: list[list[bytes]] = []
    parts: list[tuple[int, bytes]] = []
    for envelope in range(data.draw(st.integers(1, 5))):
        messages = data.draw(MESSAGES)
        packed = pack(Envelope("one", len(parts), 0.0, messages), ROOM + 128)
        sent.append(list(messages))
        parts += [(envelope, part) for part in packed]
    kept = data.draw(st.lists(st.booleans(), min_size=len(parts), max_size=len(parts)))
    there = [part for (_, part), keep in zip(parts, kept, strict=True) if keep]
    missed, messages = received(Reassembly(), there)
    whole = [
        message
        for envelope, content in enumerate(sent)
        if all(keep for (of, _), keep in zip(parts, kept, strict=True) if of == envelope)
        for message in content
    ]
    assert messages == whole
    known = [index for index, keep in enumerate(kept) if keep]
    assert missed == (known[-1] - known[0] + 1 - len(known) if known else 0)


def test_parts_of_two_envelopes_are_never_put_together() -> None:
    first, second = (
        pack(Envelope("one", number, 0.0, (letter * 200,)), ROOM + 128)
        for number, letter in ((0, b"a"), (2, b"b"))
    )
    assert len(first) == len(second) == 2
    assert received(Reassembly(), [first[0], second[1]]) == (2, [])


def test_another_incarnation_begins_anew() -> None:
    reader = Reassembly()
    (part,) = pack(Envelope("one", 7, 0.0, (b"a",)), 4096)
    assert received(reader, [part]) == (0, [b"a"])
    (part,) = pack(Envelope("two", 3, 0.0, (b"b",)), 4096)
    assert received(reader, [part]) == (0, [b"b"])
    assert (reader.incarnation, reader.number) == ("two", 3)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xc1",
        msgpack.packb(5),
        msgpack.packb([]),
        msgpack.packb([2, "one", 0, 0.0, 0, 1, False, []]),  # of another version
        msgpack.packb([1, "one", 0, 0.0, 1, 1, False, []]),  # the second part of one
        msgpack.packb([1, "one", 0, 0.0, 0, 1, False, [3]]) + b"ab",  # cut short
        msgpack.packb([1, "one", "0", 0.0, 0, 1, False, []]),
        msgpack.packb([1, "one", 0, 0.0, 0, 1, False, 7]),
    ],
)
def test_other_bytes_are_refused(data: bytes) -> None:
    with pytest.raises(NotAnEnvelope, match="no message of the bus"):
        unpack(data)


def test_no_more_is_unpacked_than_is_said_and_no_less() -> None:
    (part,) = pack(Envelope("one", 0, 0.0, (bytes(10**6),)), 1 << 20, compressed=True)
    for said in (10, 10**7):
        forged = part.replace(msgpack.packb([10**6]), msgpack.packb([said]))
        assert forged != part
        # Of what stands for a megabyte, no byte more than one is unpacked to see that.
        with pytest.raises(NotAnEnvelope, match=f"{min(said + 1, 10**6)} bytes of {said}"):
            Reassembly().take(unpack(forged))
    with pytest.raises(NotAnEnvelope):
        Reassembly().take(unpack(msgpack.packb([1, "one", 0, 0.0, 0, 1, True, [3]]) + b"abc"))


def test_a_broker_that_takes_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="too small"):
        pack(Envelope("one", 0, 0.0, (b"a",)), 100)
