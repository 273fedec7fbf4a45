"""RowBuffer: rows of a recording that were appended and are not written yet."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hardware.recording.layout import COLUMNS, PEAK


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
