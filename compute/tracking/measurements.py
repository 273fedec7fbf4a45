"""Measurements: the peaks of one exposure as the tracker uses them, with their flags weighed."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.signal.peaks import PeakFlag
from compute.tracking.settings import TrackerSettings

Array = NDArray[np.float64]

# As numbers: an IntFlag's own operations take as long as an array's.
SUSPECT_FLAGS = int(PeakFlag.SATURATED | PeakFlag.JOINT | PeakFlag.POOR_FIT | PeakFlag.UNFITTED)
"""Their standard deviations are too small."""
REPORTED_FLAGS = int(PeakFlag.SATURATED | PeakFlag.CLIPPED)
"""What makes a track's ``SUSPECT_PEAK``."""

_MERGED, _CLIPPED = int(PeakFlag.MERGED), int(PeakFlag.CLIPPED)
_NO_START = int(PeakFlag.AMBIGUOUS | PeakFlag.UNFITTED)


@dataclass(frozen=True, eq=False)
class Measurements:
    """Peaks of S sensors, K at most.

    Args:
        position_px: shape (S, K); NaN where there is none.
        variance_px2: of the positions, flags weighed, shape (S, K); 1 where there is none.
        usable: whether there is a peak that may be a track's, shape (S, K).
        can_initiate: whether a track may be started from it, shape (S, K).
        flags: PeakFlag values, shape (S, K).
    """

    position_px: Array
    variance_px2: Array
    usable: NDArray[np.bool_]
    can_initiate: NDArray[np.bool_]
    flags: NDArray[np.int32]

    @classmethod
    def of(
        cls,
        position_px: Array,
        sigma_px: Array,
        flags: NDArray[np.int32],
        sensors: int,
        settings: TrackerSettings,
    ) -> "Measurements":
        """Weigh the flags.

        Clipped peaks are not used: they are drawn inwards, by nobody knows how much. Saturated and
        ill-fitted ones, and those that overlap, count with ``suspect_sigma_factor``. One with two maxima
        may be either of two markers; one of a pattern that fits as well elsewhere serves where a
        track expects it and starts none.

        Raises:
            InvalidParameter: other shapes, or a peak's standard deviation is not positive.
        """
        position = np.asarray(position_px, dtype=np.float64)
        sigma = np.asarray(sigma_px, dtype=np.float64)
        marks = np.asarray(flags, dtype=np.int32)
        if position.ndim != 2 or len(position) != sensors:
            raise InvalidParameter(
                f"position_px has the shape {position.shape}; it must be ({sensors}, K)"
            )
        for name, value in (("sigma_px", sigma), ("peak_flags", marks)):
            if value.shape != position.shape:
                raise InvalidParameter(
                    f"{name} has the shape {value.shape}; it must be {position.shape}"
                )
        there = np.isfinite(position)
        bad = there & ~(sigma > 0.0)
        if bad.any():
            sensor, peak = (int(index) for index in np.argwhere(bad)[0])
            raise InvalidParameter(
                f"sigma_px[{sensor}, {peak}] is {sigma[sensor, peak]}; it must be above 0"
            )
        # A peak of infinite standard deviation says nothing.
        there &= np.isfinite(sigma)
        variance = np.where(there, sigma, 1.0) ** 2
        can_initiate = there
        if marks.any():
            variance[(marks & SUSPECT_FLAGS) != 0] *= settings.suspect_sigma_factor**2
            variance[(marks & _MERGED) != 0] += settings.resolution_px**2 / 12.0
            there &= (marks & _CLIPPED) == 0
            can_initiate = there & ((marks & _NO_START) == 0)
        return cls(position, variance, there, can_initiate, marks)
