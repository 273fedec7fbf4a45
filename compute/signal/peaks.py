"""Peaks of scans: a batch as arrays, one peak as a value, and their flags."""

from dataclasses import dataclass
from enum import IntFlag
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.flags import flag_names

MAX_JOINT_PEAKS: Final = 4
"""Largest number of peaks that are fitted together."""


class PeakFlag(IntFlag):
    """Reasons to use a peak with care."""

    NONE = 0
    SATURATED = 1
    """A pixel of it is at full scale: its top, and with it the standard deviation, is wrong."""
    CLIPPED = 2
    """It runs over an end of the scan: its position is drawn inwards."""
    MERGED = 4
    """It has two maxima with a valley between them that noise does not explain."""
    TRUNCATED = 8
    """Its scan had more peaks than room; the faintest were left out."""
    JOINT = 16
    """It was fitted together with neighbours that it overlaps: their errors are correlated."""
    POOR_FIT = 32
    """The line-spread function does not explain the pixels: the standard deviation is too small."""
    UNFITTED = 64
    """No fit was possible: the position is the candidate's, a centre of gravity or a pixel."""
    AMBIGUOUS = 128
    """A pattern that fits nearly as well at another place."""
    MASKED_PIXELS = 256
    """A bad pixel of its window was left out; the standard deviation holds what that costs."""


@dataclass(frozen=True)
class Peak:
    """One peak of one scan: the fields of PeakBatch, and the names of its flags.

    Flags are in lower case with hyphens; ``reduced_chi2`` is NaN for a centre of gravity.
    """

    position_px: float
    sigma_px: float
    amplitude: float
    width_px: float
    reduced_chi2: float
    flags: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class PeakBatch:
    """Peaks of L scans, at most K a scan, ordered by position; NaN where there is none.

    Args:
        count: number of peaks of each scan, int32, shape (L,).
        position_px: centres of gravity, fitted positions or readings of shadows [px],
            float64, shape (L, K).
        sigma_px: standard deviations of the positions [px], float32, shape (L, K).
        amplitude: maxima above the scan's background [counts], float32, shape (L, K).
        width_px: full widths at each peak's own threshold, interpolated between pixels [px],
            float32, shape (L, K). At a third of the maximum, a Gaussian image of standard
            deviation s has 2.96 s.
        flags: PeakFlag values, int32, shape (L, K); zero where there is no peak.
        reduced_chi2: misfit of the fitted shape, chi-square per degree of freedom, float32,
            shape (L, K); NaN for a centre of gravity, and where no degree of freedom is left.
        covariance_px2: covariance of a peak's position with those of the next MAX_JOINT_PEAKS - 1
            peaks of the scan [px^2], float32, shape (L, K, MAX_JOINT_PEAKS - 1); zero but among
            peaks that were fitted together. With the squares of ``sigma_px`` it is the whole
            covariance of a scan's positions; ``covariance`` puts it together.
    """

    count: NDArray[np.int32]
    position_px: NDArray[np.float64]
    sigma_px: NDArray[np.float32]
    amplitude: NDArray[np.float32]
    width_px: NDArray[np.float32]
    flags: NDArray[np.int32]
    reduced_chi2: NDArray[np.float32]
    covariance_px2: NDArray[np.float32]

    @classmethod
    def empty(cls, scans: int, room: int) -> "PeakBatch":
        """Return a batch without peaks.

        Args:
            scans: L, the number of scans.
            room: K, the peaks that each has room for.
        """
        shape = (scans, room)
        return cls(
            np.zeros(scans, np.int32),
            np.full(shape, np.nan),
            np.full(shape, np.nan, np.float32),
            np.full(shape, np.nan, np.float32),
            np.full(shape, np.nan, np.float32),
            np.zeros(shape, np.int32),
            np.full(shape, np.nan, np.float32),
            np.zeros((*shape, MAX_JOINT_PEAKS - 1), np.float32),
        )

    def __len__(self) -> int:
        """Return the number of scans."""
        return len(self.count)

    def covariance(self, scan: int) -> NDArray[np.float64]:
        """Return the covariance of the positions of one scan's k peaks, shape (k, k) [px^2]."""
        count = int(self.count[scan])
        covariance = np.diag(self.sigma_px[scan, :count].astype(np.float64) ** 2)
        for ahead in range(1, min(MAX_JOINT_PEAKS, count)):
            with_next = self.covariance_px2[scan, : count - ahead, ahead - 1]
            row = np.arange(count - ahead)
            covariance[row, row + ahead] = covariance[row + ahead, row] = with_next
        return covariance

    def peaks(self, scan: int) -> tuple[Peak, ...]:
        """Return the peaks of the scan of this number as values."""
        names = ("position_px", "sigma_px", "amplitude", "width_px", "reduced_chi2")
        return tuple(
            Peak(
                **{name: float(getattr(self, name)[scan, k]) for name in names},
                flags=flag_names(PeakFlag(int(self.flags[scan, k]))),
            )
            for k in range(int(self.count[scan]))
        )


def no_peaks(scans: int) -> PeakBatch:
    """Return a batch of scans without peaks and without room for one."""
    return PeakBatch.empty(scans, 0)


def number_within_scan(scan: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return each peak's number within its scan, by the peaks' ascending scans, shape (M,)."""
    return np.asarray(np.arange(len(scan)) - np.searchsorted(scan, scan))
