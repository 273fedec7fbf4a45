"""Interface of a tracker of one strobe slot, or of all markers that are lit together."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurements import Measurements
from compute.reconstruction.correspondence.grouping import Correspondence
from validation.thesis_tracking.point_reconstruction import SolvedPoints, SpacePoints
from validation.thesis_tracking.settings import ThesisSettings
from validation.thesis_tracking.track_report import TrackReport

Array = NDArray[np.float64]

MIN_AGREEING_SENSORS: Final = 4
"""Sensors whose agreement says something: three planes always meet."""
AMBIGUOUS_CONFIRMATION_EXPOSURES: Final = 10
"""In which so many must agree, before a marker counts whose peaks might be grouped otherwise."""
GROUP_EVERY_S: Final = 0.05
"""Least time between two searches for markers among what is no marker's: the dearest step."""


class SlotTracker(ABC):
    """What is seen in exposures with the same light; nothing in it looks ahead.

    Args:
        settings: of the method.
        space: reconstruction.
        marker: strobe slot, of which there is one marker; -1: all are lit.
        next_identity: gives a number that nobody has had.
    """

    def __init__(
        self,
        settings: ThesisSettings,
        space: SpacePoints,
        marker: int,
        next_identity: Callable[[], int],
    ) -> None:
        self.settings = settings
        self.space = space
        self.marker = marker
        self.next_identity = next_identity
        self._grouped_ns: int | None = None

    @property
    @abstractmethod
    def alive(self) -> bool:
        """Whether a marker is followed."""

    @abstractmethod
    def step(self, time_ns: int, peaks: Measurements) -> list[TrackReport]:
        """Return the markers after an exposure that shows them."""

    @abstractmethod
    def predicted(self, time_ns: int) -> list[TrackReport]:
        """Return the markers at a time when they are dark."""

    def _may_group(self, time_ns: int) -> bool:
        """Whether it is time for a search; a strobed marker is sought at once."""
        last = self._grouped_ns
        if last is not None and self.marker < 0 and time_ns - last < 1e9 * GROUP_EVERY_S:
            return False
        self._grouped_ns = time_ns
        return True

    @staticmethod
    def _groups_to_take(groups: Correspondence, solved: SolvedPoints) -> list[int]:
        """Return the groups that may be markers: those that are ambiguous with four sensors only.

        The most probable grouping may be wrong, and then is contradicted as markers move.
        """
        agreed = (groups.peaks >= 0).sum(axis=1) >= MIN_AGREEING_SENSORS
        good = solved.found & ~solved.inconsistent & (agreed | ~groups.ambiguous)
        rows: list[int] = np.flatnonzero(good).tolist()
        return rows

    def _may_begin(self, markers: int) -> bool:
        """Whether there may be another one beside so many."""
        return self.marker < 0 or markers == 0


def packed_columns(rows: Sequence[Sequence[float]]) -> Array:
    """Return rows of different lengths as an array, filled with NaN."""
    packed = np.full((len(rows), max(1, *map(len, rows))), np.nan)
    for row, values in zip(packed, rows, strict=True):
        row[: len(values)] = values
    return packed
