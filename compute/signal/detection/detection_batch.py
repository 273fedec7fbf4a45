"""DetectionBatch: places in lines where a matched filter answers, as arrays."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class DetectionBatch:
    """The detections in L lines, at most K a line, ordered by place.

    Args:
        count: number of detections of each line, int32, shape (L,).
        position_px: pixel where the answer is highest, int32, shape (L, K); -1 where there is none.
        response_sigma: answer in standard deviations of the line's noise, float32, shape (L, K).
        amplitude: height of the peak above its surroundings, as if it were centred on the pixel
            [counts], float32, shape (L, K).
        flags: PeakFlag values, int32, shape (L, K). SATURATED: a pixel of the peak is at full
            scale. CLIPPED: the peak runs over an end of the line. MERGED: another detection
            lies within half the filter's length, where it counts as background. TRUNCATED: the
            line had more than K; the faintest were left out.
        noise_counts: standard deviation of a pixel that was reckoned with, float64, shape (L,).
    """

    count: NDArray[np.int32]
    position_px: NDArray[np.int32]
    response_sigma: NDArray[np.float32]
    amplitude: NDArray[np.float32]
    flags: NDArray[np.int32]
    noise_counts: NDArray[np.float64]

    def __len__(self) -> int:
        """Return the number of lines."""
        return len(self.count)
