"""SharedBlockRing: lock-free ring buffer of frame blocks in shared memory.

One side writes blocks, the other reads them; both count bytes since the beginning, ``head`` of
those written and ``tail`` of those free again, and exchange them through pipes. There is no lock
that a crashed side could leave held.
"""

import mmap
import os
import struct
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hardware.recording.frame_block import FrameBlock
from hardware.recording.layout import FRAME, PEAK, Losses, point_dtype

_HEADER: Final = struct.Struct("<qqqqqqq")
_ALIGN: Final = 64
_SKIP: Final = -1
"""Number of frames that marks the unused end of the ring."""


def make_memory(size: int) -> int:
    """Return the descriptor of new anonymous memory, freed with its last user."""
    if hasattr(os, "memfd_create"):
        descriptor = os.memfd_create("lumiline-recording")
    else:
        with tempfile.TemporaryFile() as file:
            descriptor = os.dup(file.fileno())
    os.ftruncate(descriptor, size)
    return descriptor


_Section = tuple[int, np.dtype[Any], int]
"""Offset in a block, type and number of values."""


@dataclass(frozen=True)
class RingShape:
    """Size of a ring and shape of its scans.

    Args:
        size: bytes, a multiple of 64.
        sensors: of the lines.
        pixels: of each.
        lines: whether blocks have lines.
    """

    size: int
    sensors: int
    pixels: int
    lines: bool

    def sections(self, frames: int, peaks: int, points: int) -> list[_Section]:
        """Return where a block's rows, counts, peaks and points lie, and its end."""
        counts = frames * self.sensors * self.pixels if self.lines else 0
        columns, at = [], _aligned(_HEADER.size)
        for dtype, length in (
            (FRAME, frames),
            (np.dtype(np.uint16), counts),
            (PEAK, peaks),
            (point_dtype(self.sensors), points),
            (np.dtype(np.uint8), 0),
        ):
            columns.append((at, dtype, length))
            at += _aligned(length * dtype.itemsize)
        return columns


class SharedBlockRing:
    """One side's view of the memory.

    Args:
        descriptor: of the memory, which stays open.
        shape: what it holds.
    """

    def __init__(self, descriptor: int, shape: RingShape) -> None:
        self.head = 0
        self.tail = 0
        self._shape = shape
        self._bytes = np.frombuffer(mmap.mmap(descriptor, shape.size), np.uint8)

    def put(
        self,
        rows: NDArray[np.void],
        lines: Sequence[NDArray[np.uint16]],
        peaks: NDArray[np.void],
        points: NDArray[np.void],
        losses: Losses,
    ) -> bool:
        """Write frames at ``head`` and advance it; False, without effect, where they do not fit.

        Args:
            rows, peaks, points: as of FrameBlock.
            lines: of each frame, shape (S, P); ignored where the ring has none.
            losses: frames lost until now.
        """
        counts = len(rows), len(peaks), len(points)
        size = self._shape.sections(*counts)[-1][0]
        start = self.head % self._shape.size
        skipped = self._shape.size - start if start + size > self._shape.size else 0
        if self.head + skipped + size - self.tail > self._shape.size:
            return False
        if skipped:
            self._put_header(start, (skipped, _SKIP, 0, 0, 0, 0, 0))
            start = 0
        self._put_header(start, (size, *counts, *vars(losses).values()))
        block = self._block(start, *counts)
        block.rows[...] = rows
        if block.lines is not None:
            for target, line in zip(block.lines, lines, strict=True):
                target[...] = line
        block.peaks[...] = peaks
        block.points[...] = points
        self.head += skipped + size
        return True

    def take(self, head: int) -> Iterator[tuple[FrameBlock, Losses]]:
        """Yield the blocks up to ``head`` as views, valid until the next iteration.

        ``tail`` advances after each.
        """
        while self.tail < head:
            start = self.tail % self._shape.size
            header = _HEADER.unpack(self._bytes[start : start + _HEADER.size].data)
            size, frames, peaks, points, *lost = header
            if frames != _SKIP:
                yield self._block(start, frames, peaks, points), Losses(*lost)
            self.tail += size

    def _put_header(self, start: int, values: tuple[int, ...]) -> None:
        packed = np.frombuffer(_HEADER.pack(*values), np.uint8)
        self._bytes[start : start + len(packed)] = packed

    def _block(self, start: int, frames: int, peaks: int, points: int) -> FrameBlock:
        """Return views of a block's memory."""
        rows, counts, peak_records, point_records, _ = (
            self._bytes[start + at : start + at + length * dtype.itemsize].view(dtype)
            for at, dtype, length in self._shape.sections(frames, peaks, points)
        )
        shape = (frames, self._shape.sensors, self._shape.pixels)
        lines = counts.reshape(shape) if self._shape.lines else None
        return FrameBlock(rows, lines, peak_records, point_records)


def _aligned(size: int) -> int:
    return -(-size // _ALIGN) * _ALIGN
