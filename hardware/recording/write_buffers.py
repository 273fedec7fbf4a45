"""Write buffers of a recording: chunks of scans, and rows of frames and results."""

from typing import Any, Literal

import h5py
import numpy as np
from numpy.typing import NDArray

from hardware.recording.layout import CHUNK_BYTES, CHUNK_FRAMES, COLUMNS, PEAK


class ScanChunks:
    """The dataset of scans and its current chunk; chunks are written whole.

    Args:
        group: the group that gets the dataset.
        shape: number of sensors and of pixels per sensor.
        compression: as in RecordingWriter.
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

    def put(self, appended: int, lines: NDArray[np.uint16]) -> None:
        """Append scans; write each chunk that becomes full.

        Args:
            appended: number of frames appended before.
            lines: shape (F, S, P).
        """
        chunk, written = self._chunk, 0
        while written < len(lines):
            start = (appended + written) % len(chunk)
            count = min(len(chunk) - start, len(lines) - written)
            chunk[start : start + count] = lines[written : written + count]
            written += count
            if start + count == len(chunk):
                self._write(appended + written - len(chunk), appended + written)

    def write_rest(self, frames: int) -> None:
        """Write the partly filled chunk; ``frames`` is the number appended in all."""
        part = frames % len(self._chunk)
        if part:
            self._write(frames - part, frames)

    def _write(self, first: int, end: int) -> None:
        """Write the chunk that begins with frame ``first``, filled up to ``end``.

        A chunk that was written before keeps its old contents: nothing of it is lost if the
        process dies meanwhile. (A compressed chunk gets a new position each time; the old one
        is not reused.)
        """
        # Looking it up, and h5py's own resize, would take a fifth of the writer's time.
        self._lines.id.set_extent((end, *self._shape))
        if self._compressed:
            self._lines[first:end] = self._chunk[: end - first]
        else:
            self._lines.id.write_direct_chunk((first, 0, 0), self._chunk)


class RowBuffer:
    """Rows of frames, peaks and points that are not written yet, and the totals."""

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
        """Append rows."""
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
        """Return and remove the buffered rows; no columns where there are none."""
        columns = {name: np.concatenate(chunks) for name, chunks in self._columns.items() if chunks}
        peaks, points = np.concatenate(self._peaks), np.concatenate(self._points)
        for chunks in self._columns.values():
            chunks.clear()
        del self._peaks[1:], self._points[1:]
        self.rows = 0
        return columns, peaks, points
