"""ScanChunks: the lines of a recording, written to its file in whole chunks."""

from typing import Literal

import h5py
import numpy as np
from numpy.typing import NDArray

from hardware.recording.layout import CHUNK_BYTES, CHUNK_FRAMES


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
