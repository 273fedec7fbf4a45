"""TrackBatch: tracks at one instant as arrays, reported after each exposure."""

from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Self

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements
from compute.tracking.motion_model import MotionModels, combine_modes, mix_and_predict
from compute.tracking.track_management import UNSUPPORTED_EXPOSURES
from compute.tracking.tracks import Associations, Tracks

Array = NDArray[np.float64]


class TrackState(IntEnum):
    """State of a track between its start and its end."""

    TENTATIVE = 0
    """Seen too rarely yet to be told from a ghost or from false peaks."""
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
        nis: normalised innovation squared, shape (T,); NaN where no sensor saw the track.
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
        """Return the batch of no tracks, for a number of sensors."""
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


# As arrays' own numbers: an enumeration's operations take as long as an array's. TENTATIVE is 0.
_CONFIRMED, _COASTING = np.int8(TrackState.CONFIRMED), np.int8(TrackState.COASTING)
_MERGED, _AMBIGUOUS = np.int32(TrackFlag.MERGED), np.int32(TrackFlag.AMBIGUOUS)
_FEW_SENSORS, _SUSPECT_PEAK = np.int32(TrackFlag.FEW_SENSORS), np.int32(TrackFlag.SUSPECT_PEAK)
_OUTSIDE_MAP = np.int32(TrackFlag.OUTSIDE_MAP)


def to_track_batch(
    model: MeasurementModel,
    motion: MotionModels,
    tracks: Tracks,
    seen: Associations,
    peaks: Measurements,
    time_ns: int,
) -> TrackBatch:
    """Return the tracks after an exposure, predicted to it where they were not updated.

    Args:
        model: the measurement model, of S sensors.
        motion: M motion models.
        tracks: T tracks.
        seen: their associations in the exposure.
        peaks: measurements of the exposure.
        time_ns: time of the exposure [ns].
    """
    states = tracks.states
    late = np.flatnonzero(tracks.time_ns != time_ns)
    if len(late):
        states = states.rows(np.arange(len(tracks)))
        step = np.asarray((time_ns - tracks.time_ns[late]) * 1e-9, dtype=np.float64)
        states.put(late, mix_and_predict(motion, tracks.states.rows(late), step))
    whole = combine_modes(motion, states)
    mean, covariance = whole.mean.copy(), whole.covariance.copy()
    if not any(motion.has_acceleration):
        mean[:, 6:] = np.nan
        covariance[:, 6:] = covariance[:, :, 6:] = np.nan
    dof = seen.sensor_counts()
    used = seen.peaks >= 0
    state = np.where(dof > 0, _CONFIRMED, _COASTING)
    state *= tracks.confirmed
    flags = seen.merged * _MERGED
    doubt = (
        tracks.ambiguous_identity
        | seen.hypotheses_pruned
        | (tracks.unsupported >= UNSUPPORTED_EXPOSURES)
    )
    flags |= doubt * _AMBIGUOUS
    flags |= (dof < 3) * _FEW_SENSORS
    if np.count_nonzero(peaks.suspect):
        sensor = np.arange(len(model))
        suspect = used & peaks.suspect[sensor, np.maximum(seen.peaks, 0)]
        flags |= suspect.any(axis=1) * _SUSPECT_PEAK
    if model.corrections is not None:
        outside = (used & ~model.inside_hull(mean[:, :3])).any(axis=1)
        flags |= outside * _OUTSIDE_MAP
    return TrackBatch(
        tracks.identity.copy(),
        tracks.marker.copy(),
        state,
        flags,
        mean[:, :3],
        mean[:, 3:6],
        mean[:, 6:],
        covariance,
        seen.peaks,
        np.where(dof > 0, seen.nis, np.nan),
        dof,
    )
