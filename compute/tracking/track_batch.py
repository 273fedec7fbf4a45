"""TrackBatch: tracks at one instant as arrays, reported after each exposure."""

from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from compute.reconstruction.point_batch import Batch

Array = NDArray[np.float64]


class TrackState(IntEnum):
    """State of a track between its start and its end."""

    TENTATIVE = 0
    """Detected too rarely yet to be distinguished from a ghost or from false peaks."""
    CONFIRMED = 1
    """A marker."""
    COASTING = 2
    """Confirmed, but no sensor saw it at this instant: its position is predicted."""


class TrackFlag(IntFlag):
    """Why a track is to be used with care."""

    NONE = 0
    MERGED = 1
    """At least one reading of it comes from a peak that it shares with another track."""
    AMBIGUOUS = 2
    """It may have been exchanged with another track, or be a ghost: identity is uncertain."""
    FEW_SENSORS = 4
    """Fewer than three sensors saw it now: its position rests partly on the prediction."""
    SUSPECT_PEAK = 8
    """One of its peaks is suspect by the flag policy."""
    OUTSIDE_MAP = 16
    """It lies where the correction table is not valid for some used sensor."""
    NO_COVARIANCE = 32
    """It lies beyond the correction table, and nothing says how certain it is: the covariance is
    NaN."""


@dataclass(frozen=True, eq=False)
class TrackBatch(Batch):
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
        peaks: index of the peak, that each sensor saw of each track; -1: none,
            int32, shape (T, S).
        nis: normalised innovation squared, shape (T,); NaN where no sensor saw the track.
        dof: number of readings that ``nis`` sums over, int32, shape (T,).
    """

    identity: NDArray[np.int64]
    marker: NDArray[np.int32]
    state: NDArray[np.int8]
    flags: NDArray[np.int32]
    position_mm: Annotated[Array, 3]
    velocity_mm_s: Annotated[Array, 3]
    acceleration_mm_s2: Annotated[Array, 3]
    covariance: Annotated[Array, 9, 9]
    peaks: Annotated[NDArray[np.int32], "S"]
    nis: Array
    dof: NDArray[np.int32]
