"""BarHistory: the last exposures of a bar, and its readings at a time that another bar asks for."""

from collections import deque
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.fusion.alignment import STANDARD, AlignedReadings, AlignmentSettings, align

Array = NDArray[np.float64]
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class BarExposure(Generic[T]):
    """Peaks of one exposure of a bar.

    Args:
        time_ns: middle of the exposure, on the clock that all bars are referred to [ns].
        position_px: shape (S, K) [px]; NaN: none.
        variance_px2: of these, shape (S, K) [px^2].
        origin: what the peaks were taken from.
    """

    time_ns: int
    position_px: Array
    variance_px2: Array
    origin: T


class BarHistory(Generic[T]):
    """Keeps a bar's last exposures by strobe slot, and aligns their readings in time.

    Args:
        exposures: how many of each slot are kept, three or more.
        settings: how fast peaks may move.

    Raises:
        InvalidParameter: fewer than three are kept.
    """

    def __init__(self, exposures: int = 16, settings: AlignmentSettings = STANDARD) -> None:
        if exposures < 3:
            raise InvalidParameter(f"exposures is {exposures}; it must be 3 or more")
        self._kept = exposures
        self._settings = settings
        self._slots: dict[int | None, deque[BarExposure[T]]] = {}
        self.newest_ns: int | None = None
        """Time of the newest exposure; None: there was none."""

    def clear(self) -> None:
        """Forget all exposures: the bar was started again, or its clock was set."""
        self._slots.clear()
        self.newest_ns = None

    def add(self, slot: int | None, exposure: BarExposure[T]) -> None:
        """Take an exposure; one that is not later than the last of its slot begins anew.

        Args:
            slot: strobe slot that was lit; None: all markers.
            exposure: its peaks.
        """
        kept = self._slots.setdefault(slot, deque(maxlen=self._kept))
        if kept and exposure.time_ns <= kept[-1].time_ns:
            kept.clear()
        kept.append(exposure)
        self.newest_ns = exposure.time_ns

    def is_ready(self, time_ns: int, slot: int | None) -> bool:
        """Whether waiting longer brings nothing: the exposure behind the nearest one is there.

        Args:
            time_ns: the wanted time [ns].
            slot: strobe slot that was lit then; None: all markers.
        """
        kept = self._slots.get(slot)
        return kept is not None and self._nearest(kept, time_ns) < len(kept) - 1

    def at(
        self, time_ns: int, slot: int | None, shift_ns: int = 0
    ) -> tuple[BarExposure[T], AlignedReadings] | None:
        """Return the exposure next to a time, and its readings moved there.

        Args:
            time_ns: the wanted time [ns].
            slot: strobe slot that was lit then; None: all markers.
            shift_ns: by how much the bar states its exposures too late [ns].

        Returns:
            None: there is none within the distance of two exposures.
        """
        kept = self._slots.get(slot)
        wanted_ns = time_ns + shift_ns
        if not kept:
            return None
        middle = self._nearest(kept, wanted_ns)
        nearest = kept[middle]
        before = kept[middle - 1] if middle > 0 else None
        after = kept[middle + 1] if middle + 1 < len(kept) else None
        neighbours = [one for one in (before, after) if one is not None]
        distance_ns = abs(nearest.time_ns - wanted_ns)
        if any(distance_ns > abs(one.time_ns - nearest.time_ns) for one in neighbours):
            return None
        peaks = max(one.position_px.shape[1] for one in (nearest, *neighbours))
        shape = len(nearest.position_px), peaks
        position, variance = np.full((3, *shape), np.nan), np.ones((3, *shape))
        times = [-np.inf, (nearest.time_ns - wanted_ns) * 1e-9, np.inf]
        for index, one in enumerate((before, nearest, after)):
            if one is not None:
                columns = one.position_px.shape[1]
                position[index, :, :columns] = one.position_px
                variance[index, :, :columns] = one.variance_px2
                times[index] = (one.time_ns - wanted_ns) * 1e-9
        # Exposures that are not there have no peaks, and some time.
        first = times[0] if before is not None else times[1] - 1.0
        last = times[2] if after is not None else times[1] + 1.0
        found = align((first, times[1], last), position, variance, self._settings)
        columns = nearest.position_px.shape[1]
        return nearest, AlignedReadings(*(values[:, :columns] for values in vars(found).values()))

    @staticmethod
    def _nearest(kept: deque[BarExposure[T]], time_ns: int) -> int:
        """Return the index of the exposure next to a time; of two, the earlier."""
        return min(range(len(kept)), key=lambda index: (abs(kept[index].time_ns - time_ns), index))
