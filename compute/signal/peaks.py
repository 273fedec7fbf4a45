"""Peaks found in line scans: a batch as arrays, one peak as a value."""

from dataclasses import dataclass
from enum import IntFlag

import numpy as np
from numpy.typing import NDArray

from compute.flags import flag_names


class PeakFlag(IntFlag):
    """Why a peak is to be used with care."""

    NONE = 0
    SATURATED = 1
    """A pixel of it is at full scale: its top, and with it the standard deviation, is wrong."""
    CLIPPED = 2
    """It runs over an end of the line: its position is drawn inwards."""
    MERGED = 4
    """It has two maxima with a valley between them that noise does not explain."""
    TRUNCATED = 8
    """Its line had more peaks than room; the faintest were left out."""


@dataclass(frozen=True)
class Peak:
    """One peak of one line.

    Args:
        sensor: name of the sensor whose line it is in.
        position_px: centre of gravity [px]; the centre of the first pixel is 0.
        sigma_px: standard deviation of the position by the noise model [px].
        amplitude: maximum above the line's background [counts].
        width_px: full width at the peak's own threshold [px].
        flags: names of the flags that hold, in lower case with hyphens.
    """

    sensor: str
    position_px: float
    sigma_px: float
    amplitude: float
    width_px: float
    flags: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class PeakBatch:
    """The peaks of L lines, at most K a line, ordered by position; NaN where there is none.

    Args:
        count: number of peaks of each line, int32, shape (L,).
        position_px: centres of gravity [px], float64, shape (L, K).
        sigma_px: standard deviations of the positions [px], float32, shape (L, K).
        amplitude: maxima above the line's background [counts], float32, shape (L, K).
        width_px: full widths at each peak's own threshold, interpolated between pixels [px],
            float32, shape (L, K). At a third of the maximum, a Gaussian image of standard
            deviation s has 2.96 s.
        flags: PeakFlag values, int32, shape (L, K); zero where there is no peak.
    """

    count: NDArray[np.int32]
    position_px: NDArray[np.float64]
    sigma_px: NDArray[np.float32]
    amplitude: NDArray[np.float32]
    width_px: NDArray[np.float32]
    flags: NDArray[np.int32]

    def __len__(self) -> int:
        """Return the number of lines."""
        return len(self.count)

    def peaks(self, line: int, sensor: str) -> tuple[Peak, ...]:
        """Return one line's peaks as values; ``sensor`` is the name to give them."""
        return tuple(
            Peak(
                sensor,
                float(self.position_px[line, k]),
                float(self.sigma_px[line, k]),
                float(self.amplitude[line, k]),
                float(self.width_px[line, k]),
                flag_names(PeakFlag(int(self.flags[line, k]))),
            )
            for k in range(int(self.count[line]))
        )


def no_peaks(lines: int) -> PeakBatch:
    """Return the batch of lines without any peak."""
    return PeakBatch(
        np.zeros(lines, dtype=np.int32),
        np.empty((lines, 0)),
        np.empty((lines, 0), dtype=np.float32),
        np.empty((lines, 0), dtype=np.float32),
        np.empty((lines, 0), dtype=np.float32),
        np.empty((lines, 0), dtype=np.int32),
    )
