"""SharedRing: records come whole and in order, or are counted; readers do not reach the writer."""

import os
import subprocess
import sys
import zlib
from collections import deque
from collections.abc import Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.station.shared_ring import Doorbell, RingBroken, RingReader, RingWriter, new_ring


@pytest.fixture
def memory() -> Iterator[int]:
    descriptor = new_ring(1024)
    yield descriptor
    os.close(descriptor)


def test_records_come_in_order_and_whole(memory: int) -> None:
    writer, reader = RingWriter(memory), RingReader(memory)
    writer.write(b"one")
    writer.write(b"", b"tw", memoryview(b"o"))
    writer.write(b"")
    assert [record.data for record in reader.read(9)] == [b"one", b"two", b""]
    assert list(reader.read(9)) == []


def test_reader_begins_with_the_next_record_or_with_the_oldest(memory: int) -> None:
    writer = RingWriter(memory)
    writer.write(b"before")
    later, all_of_them = RingReader(memory), RingReader(memory, from_begin=True)
    writer.write(b"after")
    assert [record.data for record in later.read(9)] == [b"after"]
    assert [record.data for record in all_of_them.read(9)] == [b"before", b"after"]


def test_overwritten_records_are_counted(memory: int) -> None:
    writer, reader = RingWriter(memory), RingReader(memory, from_begin=True)
    for number in range(100):
        writer.write(bytes([number]) * 100)
    records = list(reader.read(200))
    assert records[-1].data == bytes([99]) * 100
    assert records[0].missed == 100 - len(records)
    assert all(record.missed == 0 for record in records[1:])
    assert len(records) >= 7  # 1,024 bytes hold eight of 120 but for the rest at the end


@settings(deadline=None)
@given(
    st.lists(st.one_of(st.binary(max_size=300), st.integers(1, 5)), max_size=60),
    st.sampled_from([640, 1000, 1024, 1608]),
)
def test_any_order_of_writes_and_reads(steps: list[bytes | int], capacity: int) -> None:
    """The model shares nothing with the ring: a list, of which the reader lacks the beginning."""
    memory = new_ring(capacity)
    writer, reader = RingWriter(memory), RingReader(memory)
    written: list[bytes] = []
    read = 0
    for step in steps:
        if isinstance(step, bytes):
            writer.write(step)
            written.append(step)
            continue
        for record in reader.read(step):
            read += record.missed
            assert record.data == written[read]
            read += 1
    for record in reader.read(len(written)):
        read += record.missed
        assert record.data == written[read]
        read += 1
    assert read == len(written)
    # What fits is there: nothing is overwritten before its memory is needed.
    kept = deque(RingReader(memory, from_begin=True).read(len(written)))
    taken = [16 + -(-len(data) // 8) * 8 for data in written[len(written) - len(kept) - 1 :]]
    if len(kept) < len(written):
        assert sum(taken) + max(taken) > writer.capacity
    reader.close()
    writer.close()
    os.close(memory)


def test_too_large_a_record_is_refused(memory: int) -> None:
    writer, reader = RingWriter(memory), RingReader(memory)
    with pytest.raises(ValueError, match="a record of 497 bytes does not fit; at most 496"):
        writer.write(bytes(497))
    writer.write(bytes(496))
    assert len(next(reader.read(1)).data) == 496


def test_other_memory_is_no_ring() -> None:
    read, write = os.pipe()
    for broken in (0, 64, 4096):
        descriptor = os.memfd_create("other")
        os.ftruncate(descriptor, broken)
        with pytest.raises(RingBroken):
            RingReader(descriptor)
        with pytest.raises(RingBroken):
            RingWriter(descriptor)
        os.close(descriptor)
    os.close(read)
    os.close(write)


def test_progress_tells_the_writer_how_far_the_reader_is(memory: int) -> None:
    writer, reader = RingWriter(memory), RingReader(memory)
    writer.write(b"12345678")
    writer.write(b"12345678")
    assert writer.behind == 48
    next(reader.read(1))
    reader.report_progress()
    assert writer.behind == 24


@pytest.mark.parametrize("kind", ["eventfd", "pipe"])
def test_doorbell_counts_and_never_blocks(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if kind == "pipe":
        monkeypatch.delattr(os, "eventfd")
    bell = Doorbell()
    assert bell.clear() == 0
    for _ in range(3):
        Doorbell.ring(bell.write_descriptor)
    assert bell.clear() == 3
    assert bell.clear() == 0
    for _ in range(100_000):
        Doorbell.ring(bell.write_descriptor)
    assert bell.clear() > 0
    bell.close()


_WRITER = """
import sys, zlib
from service.station.shared_ring import Doorbell, RingWriter
writer = RingWriter(int(sys.argv[1]))
for number in range(int(sys.argv[3])):
    data = number.to_bytes(8, "little") * (1 + number * 7919 % 400)
    writer.write(zlib.crc32(data).to_bytes(4, "little"), data)
    Doorbell.ring(int(sys.argv[2]))
"""


@pytest.mark.slow
@pytest.mark.parametrize("capacity", [8192, 1 << 20])
def test_fast_writer_in_another_process(capacity: int) -> None:
    """Lapped again and again, a reader never takes a torn record for a whole one."""
    count = 100_000
    memory, bell = new_ring(capacity), Doorbell()
    reader = RingReader(memory, from_begin=True)
    lost: RingReader | None = RingReader(memory)  # reads nothing, and is gone in the middle
    arguments = [str(memory), str(bell.write_descriptor), str(count)]
    process = subprocess.Popen(
        [sys.executable, "-c", _WRITER, *arguments], pass_fds=(memory, bell.write_descriptor)
    )
    seen = missed = 0
    newest = -1
    while newest < count - 1:
        bell.clear()
        for record in reader.read(1000):
            check, data = record.data[:4], record.data[4:]
            assert zlib.crc32(data) == int.from_bytes(check, "little")
            number = int.from_bytes(data[:8], "little")
            assert number == newest + 1 + record.missed
            newest, seen, missed = number, seen + 1, missed + record.missed
        if newest > count // 2 and lost is not None:
            lost.close()
            lost = None
        assert process.poll() in (None, 0)
    assert seen + missed == count
    assert process.wait(60) == 0
    reader.close()
    bell.close()
    os.close(memory)
