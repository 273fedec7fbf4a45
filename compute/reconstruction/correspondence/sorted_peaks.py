"""SortedPeaks: the peaks of one exposure in an order that does not depend on how they came."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SortedPeaks:
    """Peaks of S sensors, each line's in ascending order, NaN behind them.

    Args:
        position_px: shape (S, K) [px].
        sigma_px: their standard deviations as readings of a marker, shape (S, K) [px].
        shared: which may be two markers', shape (S, K).
        original_index: index that each had, shape (S, K).
        count: how many there are, shape (S,).
    """

    position_px: Array
    sigma_px: Array
    shared: NDArray[np.bool_]
    original_index: NDArray[np.intp]
    count: NDArray[np.intp]

    @classmethod
    def of(
        cls,
        position_px: Array,
        sigma_px: Array,
        merged: NDArray[np.bool_] | None,
        merged_sigma_px: float,
    ) -> "SortedPeaks":
        """Sort peaks (S, K); those that are merged get the deviation ``merged_sigma_px`` on top."""
        usable = np.isfinite(position_px) & np.isfinite(sigma_px)
        place = np.where(usable, position_px, np.nan)
        order = place.argsort(axis=-1, kind="stable")
        if (place[:, 1:] == place[:, :-1]).any():
            # Equal peaks, side by side or not: by their deviations.
            order = np.lexsort((sigma_px, place), axis=-1)
        rows = np.arange(len(place))[:, None]
        sigma = sigma_px[rows, order]
        if merged is None:
            shared = np.zeros(place.shape, dtype=np.bool_)
        else:
            shared = merged[rows, order]
            sigma = np.where(shared, np.hypot(sigma, merged_sigma_px), sigma)
        return cls(place[rows, order], sigma, shared, order, usable.sum(axis=1))

    def __len__(self) -> int:
        """Return the number of sensors."""
        return len(self.position_px)

    @property
    def room(self) -> int:
        """Peaks of a line at most, K."""
        return int(self.position_px.shape[1])

    @cached_property
    def capacity(self) -> dict[int, int]:
        """By ``sensor * K + peak``: how many markers may share it, where that is more than one."""
        return dict.fromkeys(np.flatnonzero(self.shared).tolist(), 2)

    def readings(self, choice: NDArray[np.intp]) -> tuple[Array, Array]:
        """Return readings and deviations of choices (C, S) of peaks; NaN where -1."""
        sensor = np.arange(len(self))
        none = choice < 0
        readings = self.position_px[sensor, choice]
        sigma = self.sigma_px[sensor, choice]
        readings[none] = np.nan
        sigma[none] = np.nan
        return readings, sigma
