"""TrackBatch: tracks at one instant as arrays."""

from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class TrackState(IntEnum):
    """Where a track is in its life."""

    TENTATIVE = 0
    """Seen too few times yet to be told from a ghost or noise."""
    CONFIRMED = 1
    """A marker."""
    COASTING = 2
    """A confirmed track that nothing was seen of at this instant: its position is predicted."""


class TrackFlag(IntFlag):
    """Why a track is to be used with care."""

    NONE = 0
    MERGED = 1
    """At least one reading of it comes from a peak that it shares with another track."""
    AMBIGUOUS = 2
    """It may have changed places with another track, or be a ghost: identity is not sure."""
    FEW_SENSORS = 4
    """Fewer than three sensors saw it now: what the others would add is predicted."""
    SUSPECT_PEAK = 8
    """One of its peaks is suspect by the flag policy."""
    OUTSIDE_MAP = 16
    """The correction table vouches for the reading of some used sensor not there."""


@dataclass(frozen=True, eq=False)
class TrackBatch:
    """T tracks after the frame of one instant.

    Args:
        identity: number of the track, never used again, int64, shape (T,).
        marker: strobe slot or blinking code of the marker; -1: not known, int32, shape (T,).
        state: TrackState values, int8, shape (T,).
        flags: TrackFlag values, int32, shape (T,).
        position_mm: shape (T, 3) [mm].
        velocity_mm_s: shape (T, 3) [mm/s].
        acceleration_mm_s2: shape (T, 3) [mm/s^2]; NaN where the motion model has none.
        covariance: of position, velocity and acceleration in this order, shape (T, 9, 9); NaN
            where the motion model has no acceleration.
        peaks: index of the peak, in its line, that each sensor saw of each track; -1: none,
            int32, shape (T, S).
        nis: normalised innovation squared of what was seen now, shape (T,); NaN: nothing was.
        dof: number of readings that ``nis`` sums over, int32, shape (T,).
    """

    identity: NDArray[np.int64]
    marker: NDArray[np.int32]
    state: NDArray[np.int8]
    flags: NDArray[np.int32]
    position_mm: Array
    velocity_mm_s: Array
    acceleration_mm_s2: Array
    covariance: Array
    peaks: NDArray[np.int32]
    nis: Array
    dof: NDArray[np.int32]

    @classmethod
    def empty(cls, sensors: int) -> Self:
        """Return the batch of no tracks, of so many sensors."""
        return cls(
            np.empty(0, np.int64),
            np.empty(0, np.int32),
            np.empty(0, np.int8),
            np.empty(0, np.int32),
            np.empty((0, 3)),
            np.empty((0, 3)),
            np.empty((0, 3)),
            np.empty((0, 9, 9)),
            np.empty((0, sensors), np.int32),
            np.empty(0),
            np.empty(0, np.int32),
        )

    def __len__(self) -> int:
        """Return the number of tracks."""
        return len(self.identity)
