"""SharedRing: records of one writer for many readers of this machine, in shared memory.

The writer never waits: it overwrites the oldest records. A reader has a cursor of its own, copies a
record out, and then looks whether the writer has reached it meanwhile; what it was too slow for it
skips and counts. Nothing a reader does, its end included, reaches the writer.
"""

import mmap
import os
import struct
import sys
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Final

_MAGIC: Final = 0x4C554D49_52494E47  # "LUMIRING"
_HEADER_BYTES: Final = 64
_FIELDS: Final = struct.Struct("<QQ")  # of a record: bytes that follow, number
_ALIGNMENT: Final = 8
_MAGIC_AT, _CAPACITY_AT, _TAIL_AT, _HEAD_AT, _NUMBER_AT, _DONE_AT = range(6)
"""Words of the header: magic number, bytes of the ring, oldest whole record, end of the newest one,
records written, and how far the reader that is waited for has come. Positions only grow; where they
lie in the memory is their remainder by the capacity."""
_SKIP: Final = (1 << 64) - 1  # in place of a record's number: the ring goes on at its beginning


class RingBroken(Exception):
    """The memory is no ring, or what it holds is no sequence of records."""


class _Memory:
    """The shared memory, as words of its header and bytes of its records."""

    def __init__(self, descriptor: int) -> None:
        size = os.fstat(descriptor).st_size
        if size <= _HEADER_BYTES:
            raise RingBroken(f"a ring has more than {_HEADER_BYTES} bytes; this has {size}")
        self.map = mmap.mmap(descriptor, size)
        self._view = memoryview(self.map)
        self.words = self._view[:_HEADER_BYTES].cast("Q")
        self.records = self._view[_HEADER_BYTES:]

    def checked_capacity(self) -> int:
        """Return the bytes of all records; raises RingBroken where this is no ring."""
        capacity = self.words[_CAPACITY_AT]
        if self.words[_MAGIC_AT] != _MAGIC or capacity != len(self.records):
            self.close()
            raise RingBroken("the shared memory is not that of a ring of this version")
        return capacity

    def close(self) -> None:
        """Release it."""
        self.words.release()
        self.records.release()
        self._view.release()
        self.map.close()


def new_ring(capacity: int) -> int:
    """Return the descriptor of shared memory with an empty ring; the caller closes it.

    Args:
        capacity: bytes that the records take together, each with 16 bytes more, rounded up to 8.
    """
    capacity = -(-capacity // _ALIGNMENT) * _ALIGNMENT
    descriptor = _anonymous_memory(_HEADER_BYTES + capacity)
    memory = _Memory(descriptor)
    memory.words[_CAPACITY_AT], memory.words[_MAGIC_AT] = capacity, _MAGIC
    memory.close()
    return descriptor


class RingWriter:
    """Writes records; any thread may. There is one for each ring, from its beginning.

    Args:
        descriptor: of the ring's memory; stays the caller's.

    Raises:
        RingBroken: the memory is not that of a ring.
    """

    def __init__(self, descriptor: int) -> None:
        self._memory = _Memory(descriptor)
        self._words = self._memory.words
        self.capacity = self._memory.checked_capacity()
        self._starts: deque[int] = deque()
        self._head = self._number = 0
        self._lock = Lock()

    def write(self, *parts: bytes | memoryview) -> None:
        """Append a record that consists of these parts, over the oldest ones.

        Raises:
            ValueError: it is larger than half the ring.
        """
        size = sum(len(part) for part in parts)
        taken = _FIELDS.size + -(-size // _ALIGNMENT) * _ALIGNMENT
        if taken > self.capacity // 2:
            raise ValueError(
                f"a record of {size} bytes does not fit; at most {self.capacity // 2 - 16} bytes do"
            )
        with self._lock:
            start = self._head
            at = start % self.capacity
            gap = self.capacity - at if at + taken > self.capacity else 0
            self._make_room(start + gap + taken)
            records = self._memory.records
            if gap:
                # A rest that is too short for the fields is known by its length.
                if gap >= _FIELDS.size:
                    _FIELDS.pack_into(records, at, gap - _FIELDS.size, _SKIP)
                start, at = start + gap, 0
            _FIELDS.pack_into(records, at, size, self._number)
            at += _FIELDS.size
            for part in parts:
                records[at : at + len(part)] = part
                at += len(part)
            self._starts.append(start)
            self._head, self._number = start + taken, self._number + 1
            self._words[_NUMBER_AT] = self._number
            # Last: a reader takes what lies before it for whole.
            self._words[_HEAD_AT] = self._head

    def _make_room(self, end: int) -> None:
        """Move the tail, before anything behind it is overwritten."""
        while self._starts and self._starts[0] < end - self.capacity:
            self._starts.popleft()
        self._words[_TAIL_AT] = self._starts[0] if self._starts else self._head

    @property
    def head(self) -> int:
        """Position behind the newest record."""
        return self._head

    @property
    def behind(self) -> int:
        """How many bytes the reader that says so has not read yet."""
        return self._head - self._words[_DONE_AT]

    def close(self) -> None:
        """Release the memory; it goes on for readers that have it open."""
        self._memory.close()


@dataclass(frozen=True)
class Record:
    """One record.

    Args:
        data: its bytes.
        missed: records before it that the reader was too slow for.
    """

    data: bytes
    missed: int


class RingReader:
    """Reads records in order from now on; used by one thread.

    Args:
        descriptor: of the writer's memory; stays the caller's.
        from_begin: begin with the oldest record that is there; else with the next.

    Raises:
        RingBroken: the memory is not that of a ring.
    """

    def __init__(self, descriptor: int, *, from_begin: bool = False) -> None:
        self._memory = _Memory(descriptor)
        self._capacity = self._memory.checked_capacity()
        self._words = words = self._memory.words
        self.position = words[_TAIL_AT] if from_begin else words[_HEAD_AT]
        """Position behind the newest record that was read."""
        self._next = 0 if from_begin else None

    def read(self, limit: int) -> Iterator[Record]:
        """Yield the next records; ends where there is no more.

        Args:
            limit: how many at most. With as many as the doorbell was rung for, they are whole also
                on processors that make writes visible in another order.

        Raises:
            RingBroken: what stands there is no record.
        """
        for _ in range(limit):
            record = self._take()
            if record is None:
                return
            yield record

    def report_progress(self) -> None:
        """Tell the writer how far this reader has come; one reader of a ring may."""
        self._words[_DONE_AT] = self.position

    def _take(self) -> Record | None:
        while self.position < self._words[_HEAD_AT]:
            position = self.position
            taken = self._copy(position)
            # Whole only if the writer has not come here meanwhile.
            if self._words[_TAIL_AT] > position:
                self.position = self._words[_TAIL_AT]
                continue
            if taken is None:
                raise RingBroken(f"there is no record at {position} of the ring")
            data, number, self.position = taken
            if data is None:
                continue
            missed = 0 if self._next is None else number - self._next
            self._next = number + 1
            return Record(data, missed)
        return None

    def _copy(self, position: int) -> tuple[bytes | None, int, int] | None:
        """Return a copy of a record, its number and its end; None: it makes no sense.

        Bytes of None: the ring goes on at its beginning.
        """
        at = position % self._capacity
        rest = self._capacity - at
        if rest < _FIELDS.size:
            return None, 0, position + rest
        size, number = _FIELDS.unpack_from(self._memory.records, at)
        if number == _SKIP:
            return None, 0, position + rest
        if size > rest - _FIELDS.size:
            return None
        begin = at + _FIELDS.size
        end = position + _FIELDS.size + -(-size // _ALIGNMENT) * _ALIGNMENT
        return bytes(self._memory.records[begin : begin + size]), number, end

    def close(self) -> None:
        """Release the memory."""
        self._memory.close()


class Doorbell:
    """Wakes a reader in another process after each record; the writer never waits for it.

    Attributes:
        descriptor: readable after ``ring`` until ``clear``; an eventfd, or a pipe's end.
        write_descriptor: what ``ring`` writes to.
    """

    def __init__(self) -> None:
        if hasattr(os, "eventfd"):
            self.descriptor = self.write_descriptor = os.eventfd(
                0, os.EFD_NONBLOCK | os.EFD_CLOEXEC
            )
        else:
            self.descriptor, self.write_descriptor = os.pipe()
            os.set_blocking(self.descriptor, False)
            os.set_blocking(self.write_descriptor, False)

    @staticmethod
    def ring(write_descriptor: int) -> None:
        """Wake the reader; a full pipe has woken it already."""
        with suppress(BlockingIOError):
            os.write(write_descriptor, _ONE)

    def clear(self) -> int:
        """Return how often it was rung since, for now at least."""
        try:
            rung = os.read(self.descriptor, 4096)
        except BlockingIOError:
            return 0
        if self.descriptor == self.write_descriptor:
            return int.from_bytes(rung, sys.byteorder)
        return len(rung) // len(_ONE)

    def close(self) -> None:
        """Close it."""
        for descriptor in {self.descriptor, self.write_descriptor}:
            os.close(descriptor)


_ONE: Final = struct.pack("=Q", 1)


def _anonymous_memory(size: int) -> int:
    """Return the descriptor of memory without a name, which ends with its last user."""
    if hasattr(os, "memfd_create"):
        descriptor = os.memfd_create("lumiline-ring", os.MFD_CLOEXEC)
    else:
        import tempfile

        descriptor, path = tempfile.mkstemp(prefix="lumiline-ring-")
        Path(path).unlink()
    os.ftruncate(descriptor, size)
    return descriptor
