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

    def block_bytes(self, frames: int, peaks: int, points: int) -> int:
        """Return the size of a block [bytes]."""
        parts = (
            _HEADER.size,
            frames * FRAME.itemsize,
            frames * self.sensors * self.pixels * 2 if self.lines else 0,
            peaks * PEAK.itemsize,
            points * point_dtype(self.sensors).itemsize,
        )
        return sum(map(_aligned, parts))


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
        self._point = point_dtype(shape.sensors)
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
        size = self._shape.block_bytes(len(rows), len(peaks), len(points))
        start = self.head % self._shape.size
        skipped = self._shape.size - start if start + size > self._shape.size else 0
        if self.head + skipped + size - self.tail > self._shape.size:
            return False
        if skipped:
            self._put_header(start, (skipped, _SKIP, 0, 0, 0, 0, 0))
            start = 0
        counts = (size, len(rows), len(peaks), len(points))
        lost = (losses.dropped_compute, losses.dropped_writer, losses.refused)
        self._put_header(start, counts + lost)
        at = start + _aligned(_HEADER.size)
        at = self._put(at, rows)
        if self._shape.lines:
            place = self._view(at, np.dtype(np.uint16), len(rows) * self._line_pixels)
            shaped = place.reshape(len(rows), self._shape.sensors, self._shape.pixels)
            for own, line in zip(shaped, lines, strict=True):
                own[...] = line
            at += _aligned(place.nbytes)
        at = self._put(at, peaks)
        self._put(at, points)
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
                at = start + _aligned(_HEADER.size)
                rows = self._view(at, FRAME, frames)
                at += _aligned(rows.nbytes)
                lines = None
                if self._shape.lines:
                    flat = self._view(at, np.dtype(np.uint16), frames * self._line_pixels)
                    lines = flat.reshape(frames, self._shape.sensors, self._shape.pixels)
                    at += _aligned(flat.nbytes)
                found_peaks = self._view(at, PEAK, peaks)
                at += _aligned(found_peaks.nbytes)
                found_points = self._view(at, self._point, points)
                yield FrameBlock(rows, lines, found_peaks, found_points), Losses(*lost)
            self.tail += size

    @property
    def _line_pixels(self) -> int:
        return self._shape.sensors * self._shape.pixels

    def _put_header(self, start: int, values: tuple[int, ...]) -> None:
        packed = np.frombuffer(_HEADER.pack(*values), np.uint8)
        self._bytes[start : start + len(packed)] = packed

    def _put(self, at: int, values: NDArray[Any]) -> int:
        """Write values at an offset; return the offset after them."""
        self._view(at, values.dtype, len(values))[...] = values
        return at + _aligned(values.nbytes)

    def _view(self, at: int, dtype: np.dtype[Any], count: int) -> NDArray[Any]:
        return self._bytes[at : at + count * dtype.itemsize].view(dtype)


def _aligned(size: int) -> int:
    return -(-size // _ALIGN) * _ALIGN
