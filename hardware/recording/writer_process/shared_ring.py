"""SharedBlockRing: memory shared with the process that records, as a ring of blocks of frames.

One side puts blocks, the other takes them; both count the bytes since the beginning, ``head`` of
what was put and ``tail`` of what is free again, and tell one another by pipes. The ring itself
holds no lock: a side that dies leaves the other nothing to wait for.
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
"""Number of frames of a block that is none, but the unused end of the ring."""


def make_memory(size: int) -> int:
    """Return the descriptor of new memory without a name; it goes with its last user."""
    if hasattr(os, "memfd_create"):
        descriptor = os.memfd_create("lumiline-recording")
    else:
        with tempfile.TemporaryFile() as file:
            descriptor = os.dup(file.fileno())
    os.ftruncate(descriptor, size)
    return descriptor


@dataclass(frozen=True)
class RingShape:
    """What a ring holds.

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
        """Return how many bytes a block takes."""
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
        """Put frames behind ``head``, which moves on; False, and nothing, without room for them.

        Args:
            rows, peaks, points: as of FrameBlock.
            lines: of each frame, shape (S, P); not looked at when the ring has none.
            losses: what was lost until now.
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
        """Yield the blocks up to ``head``; views, to be used before the next is asked for.

        ``tail`` moves on behind each.
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
        """Put values there; return the place behind them."""
        self._view(at, values.dtype, len(values))[...] = values
        return at + _aligned(values.nbytes)

    def _view(self, at: int, dtype: np.dtype[Any], count: int) -> NDArray[Any]:
        return self._bytes[at : at + count * dtype.itemsize].view(dtype)


def _aligned(size: int) -> int:
    return -(-size // _ALIGN) * _ALIGN
