"""Mean and temporal variance of each pixel over captures of an unchanging scene."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.parameter_checks import require, require_shape

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CaptureStatistics:
    """Statistics of the N pixels of one sensor over F captures of one unchanging scene.

    Args:
        frames: F.
        mean: mean counts, shape (N,).
        variance: half the mean square of differences between successive captures, less the change
            that all pixels share, shape (N,) [counts^2]: the temporal noise by EMVA 1288, section
            6.6, which slow drift and flicker of the light do not raise. NaN for one capture.
        minimum: smallest counts, shape (N,).
        maximum: largest counts, shape (N,).
    """

    frames: int
    mean: Array
    variance: Array
    minimum: Array
    maximum: Array

    @classmethod
    def of(cls, captures: NDArray[np.uint16]) -> "CaptureStatistics":
        """Return the statistics of captures, shape (F, N).

        Raises:
            InvalidParameter: another shape, or no capture.
        """
        accumulator = CaptureAccumulator()
        accumulator.add(captures)
        return accumulator.statistics()


class CaptureAccumulator:
    """Takes captures of one sensor as they come and keeps sums, not captures."""

    def __init__(self) -> None:
        self._frames = 0
        self._sum = self._squares = self._minimum = self._maximum = np.zeros(0)
        self._last = np.zeros(0)

    def add(self, captures: NDArray[np.uint16]) -> None:
        """Take further captures, shape (F, N), in the order of their exposures.

        Raises:
            InvalidParameter: another shape, or another number of pixels than before.
        """
        counts = np.asarray(captures, dtype=np.float64)
        require_shape(counts.ndim == 2, "be (F, N)", captures=counts)
        if len(counts) == 0:
            return
        if self._frames == 0:
            self._sum = np.zeros(counts.shape[1])
            self._squares = np.zeros(counts.shape[1])
            self._minimum = np.full(counts.shape[1], np.inf)
            self._maximum = np.full(counts.shape[1], -np.inf)
        else:
            pixels = len(self._sum)
            require_shape(counts.shape[1] == pixels, f"be (F, {pixels})", captures=counts)
        chain = np.concatenate([self._last[None], counts]) if self._frames else counts
        change = np.diff(chain, axis=0)
        change -= np.median(change, axis=1, keepdims=True)
        self._squares = self._squares + (change**2).sum(axis=0)
        self._sum = self._sum + counts.sum(axis=0)
        self._minimum = np.minimum(self._minimum, counts.min(axis=0))
        self._maximum = np.maximum(self._maximum, counts.max(axis=0))
        self._last = counts[-1]
        self._frames += len(counts)

    @property
    def frames(self) -> int:
        """Number of captures so far."""
        return self._frames

    def statistics(self) -> CaptureStatistics:
        """Return the statistics of all captures so far.

        Raises:
            InvalidParameter: there is none.
        """
        require(self._frames > 0, "be 1 or more", captures=self._frames)
        pairs = self._frames - 1
        variance = self._squares / (2.0 * pairs) if pairs else np.full(len(self._sum), np.nan)
        return CaptureStatistics(
            self._frames, self._sum / self._frames, variance, self._minimum, self._maximum
        )
