"""Median filter of a scan, thesis 4.2.1."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import rank_filter

from compute.signal.centroid_settings import require_choice, require_whole
from compute.signal.thesis_pipeline.steps import (
    MAX_TAPS,
    Array,
    Compensation,
    ScanFilter,
    as_scans,
)


@dataclass(frozen=True)
class MedianFilter(ScanFilter):
    """The median of as many neighbouring pixels as the aperture has, thesis 4.2.1.

    An even aperture has no middle pixel: pixel k becomes the mean of the two middle values of
    the pixels ``k - n/2 .. k + n/2 - 1``, whose centre is at ``k - 1/2``. The scan moves by half
    a pixel to the right, as the columns for apertures 4 and 8 of Tables C.2 to C.4 did. Beyond
    its ends a scan goes on with its end's value.

    A median has no phase response: the compensation is "none" or "delay". A flank that only
    rises or falls stays as it is under an odd aperture; tops are flattened.

    Args:
        aperture: number of pixels, 2 to 1024; 1 changes nothing.
        compensation: "delay" moves positions back by the half pixel of even apertures.

    Raises:
        InvalidParameter: a value outside its range, or "phase".
    """

    aperture: int
    compensation: Compensation = "delay"

    def __post_init__(self) -> None:
        require_whole("aperture", self.aperture, 1, MAX_TAPS)
        require_choice("compensation", self.compensation, ("none", "delay"))

    @property
    def delay_px(self) -> float:
        """Half a pixel for an even aperture."""
        return 0.0 if self.aperture % 2 else 0.5

    @property
    def reach_px(self) -> float:
        """Half the aperture."""
        return float(self.aperture // 2)

    def apply(self, scans: ArrayLike) -> Array:
        """Filter scans (..., P)."""
        values = as_scans(scans)
        # In scans one by one SciPy keeps the window sorted as it moves on.
        rows = [self._filter_scan(scan) for scan in values.reshape(-1, values.shape[-1])]
        return np.array(rows, dtype=np.float64).reshape(values.shape)

    def _filter_scan(self, scan: Array) -> Array:
        size, half = self.aperture, self.aperture // 2
        upper = np.asarray(rank_filter(scan, half, size=size, mode="nearest"))
        if size % 2:
            return upper
        return 0.5 * (upper + np.asarray(rank_filter(scan, half - 1, size=size, mode="nearest")))

    def adjoint(self, weights: Array) -> Array:
        """Return the weights as they are, for an even aperture with the half pixel.

        Assumed, as a median is not linear: it passes noise as if it left the scan alone. That
        is so on flanks steeper than the noise; on level stretches the slow part of the noise, to
        which a centre of gravity answers, grows by up to pi/2 in variance.
        """
        if self.aperture % 2:
            return weights
        back = np.zeros_like(weights)
        back[..., :-1] = 0.5 * (weights[..., :-1] + weights[..., 1:])
        back[..., -1] = 0.5 * weights[..., -1]
        back[..., 0] += 0.5 * weights[..., 0]
        return back
