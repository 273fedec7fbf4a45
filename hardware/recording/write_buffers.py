"""ScanChunks: the lines of a recording, written to its file in whole chunks."""

from typing import Any, Literal

import h5py
import numpy as np
from numpy.typing import NDArray

from hardware.recording.layout import CHUNK_BYTES, CHUNK_FRAMES, COLUMNS, PEAK


class ScanChunks:
    """The dataset of lines, and the chunk of it that is being filled.

    Args:
        group: where the dataset is made.
        shape: sensors, and pixels of each.
        compression: as of RecordingWriter.
    """

    def __init__(
        self,
        group: h5py.Group,
        shape: tuple[int, int],
        compression: Literal["gzip", "lzf"] | None,
    ) -> None:
        self._shape = shape
        self._compressed = compression is not None
        frame_bytes = 2 * shape[0] * shape[1]
        frames = max(1, min(CHUNK_FRAMES, CHUNK_BYTES // frame_bytes))
        self._chunk = np.zeros((frames, *shape), np.uint16)
        self._lines = group.create_dataset(
            "lines",
            shape=(0, *shape),
            maxshape=(None, *shape),
            dtype=np.uint16,
            chunks=self._chunk.shape,
            compression=compression,
            compression_opts=1 if compression == "gzip" else None,
            shuffle=self._compressed,
        )

    def put(self, place: int, lines: NDArray[np.uint16]) -> None:
        """Fill the chunk, and write it each time that it is full.

        Args:
            place: frames that were put before.
            lines: shape (F, S, P).
        """
        chunk, taken = self._chunk, 0
        while taken < len(lines):
            start = (place + taken) % len(chunk)
            count = min(len(chunk) - start, len(lines) - taken)
            chunk[start : start + count] = lines[taken : taken + count]
            taken += count
            if start + count == len(chunk):
                self._write(place + taken - len(chunk), place + taken)

    def write_rest(self, frames: int) -> None:
        """Write the chunk as far as it is filled; ``frames`` were put in all."""
        part = frames % len(self._chunk)
        if part:
            self._write(frames - part, frames)

    def _write(self, first: int, end: int) -> None:
        """Write the chunk that begins with frame ``first``, filled up to ``end``.

        A chunk that was written before is the same up to where it was filled then: nothing of it
        is lost if the process dies meanwhile. (Compressed, it gets a new place each time, and the
        old one is not used again.)
        """
        # Looking it up, and h5py's own resize, would take a fifth of the writer's time.
        self._lines.id.set_extent((end, *self._shape))
        if self._compressed:
            self._lines[first:end] = self._chunk[: end - first]
        else:
            self._lines.id.write_direct_chunk((first, 0, 0), self._chunk)


class RowBuffer:
    """What was appended and is not written yet but for the lines, and how much there is in all."""

    def __init__(self, point: np.dtype[Any]) -> None:
        self.frames = self.peaks = self.points = self.rows = 0
        self._columns: dict[str, list[NDArray[Any]]] = {name: [] for name in COLUMNS}
        self._peaks: list[NDArray[np.void]] = [np.empty(0, PEAK)]
        self._points: list[NDArray[np.void]] = [np.empty(0, point)]

    def add(
        self,
        columns: dict[str, NDArray[Any]],
        peaks: NDArray[np.void],
        points: NDArray[np.void],
    ) -> None:
        """Keep rows until they are taken."""
        for name, values in columns.items():
            self._columns[name].append(values)
        self._peaks.append(peaks)
        self._points.append(points)
        self.rows += len(columns["sequence"])
        self.frames += len(columns["sequence"])
        self.peaks += len(peaks)
        self.points += len(points)

    def take(
        self,
    ) -> tuple[dict[str, NDArray[Any]], NDArray[np.void], NDArray[np.void]]:
        """Return the rows that wait, which are forgotten; no columns where none wait."""
        columns = {name: np.concatenate(kept) for name, kept in self._columns.items() if kept}
        peaks, points = np.concatenate(self._peaks), np.concatenate(self._points)
        for kept in self._columns.values():
            kept.clear()
        del self._peaks[1:], self._points[1:]
        self.rows = 0
        return columns, peaks, points
