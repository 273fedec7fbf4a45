"""Track of a target along one sensor, and the reason of its end."""

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class TrackEnd(Enum):
    """How a track ended."""

    RUNNING = "running"
    """It has not."""
    SHORT_LIFE = "short-life"
    """It was young and its target was not seen again: a false one, by section 6.2.2."""
    ABSORBED = "taken"
    """It was young and its target came to occupy the track of another."""
    LOST = "lost"
    """Its target was not seen for too long."""


@dataclass(frozen=True, eq=False)
class SensorTrack:
    """One track along one sensor.

    Args:
        number: never used again.
        first_scan: the scan in which it began.
        position_px: in this scan and those after it, predicted where nothing was seen, shape
            (N,).
        seen: whether a point was associated, bool, shape (N,).
        shared: whether that point is another track's as well, bool, shape (N,).
        end: how it ended.
    """

    number: int
    first_scan: int
    position_px: Array
    seen: NDArray[np.bool_]
    shared: NDArray[np.bool_]
    end: TrackEnd

    @property
    def life(self) -> int:
        """Number of scans in which its target was seen."""
        return int(self.seen.sum())


class GrowingTrack:
    """A track that scans are added to.

    Args:
        number: never used again.
        first_scan: the scan in which it begins.
        position_px: of the point that it begins with.
    """

    def __init__(self, number: int, first_scan: int, position_px: float) -> None:
        self.number = number
        self.first_scan = first_scan
        self.position_px = [position_px]
        self.life = 1
        self.missed = 0
        self._seen = [True]
        self._shared = [False]

    def add(self, position_px: float, *, seen: bool, shared: bool) -> None:
        """Add a scan: a point, which may be another track's too, or a predicted position."""
        self.position_px.append(position_px)
        self._seen.append(seen)
        self._shared.append(shared)
        self.life += seen
        self.missed = 0 if seen else self.missed + 1

    @property
    def is_shared(self) -> bool:
        """Whether its point of the last scan is another track's as well."""
        return self._shared[-1]

    def forget(self, most: int) -> None:
        """Forget all but the last ``most`` scans; ``life`` stays what it was."""
        gone = len(self.position_px) - most
        if gone > 0:
            del self.position_px[:gone], self._seen[:gone], self._shared[:gone]
            self.first_scan += gone

    def finished(self, end: TrackEnd) -> SensorTrack:
        """Return it as it is now."""
        return SensorTrack(
            self.number,
            self.first_scan,
            np.array(self.position_px),
            np.array(self._seen),
            np.array(self._shared),
            end,
        )
