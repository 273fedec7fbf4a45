"""The report: tracks and what they saw as a TrackBatch of one instant."""

import numpy as np

from compute.tracking.frame_peaks import REPORTED, FramePeaks
from compute.tracking.life_cycle import WEAK_EXPOSURES
from compute.tracking.motion_model import MotionModels
from compute.tracking.reading_model import ReadingModel
from compute.tracking.seen import Seen
from compute.tracking.states import combined, predicted
from compute.tracking.track_batch import TrackBatch, TrackFlag, TrackState
from compute.tracking.tracks import Tracks

# As arrays' own numbers: an enumeration's operations take as long as an array's. TENTATIVE is 0.
_CONFIRMED, _COASTING = np.int8(TrackState.CONFIRMED), np.int8(TrackState.COASTING)
_MERGED, _AMBIGUOUS = np.int32(TrackFlag.MERGED), np.int32(TrackFlag.AMBIGUOUS)
_FEW_SENSORS, _DOUBTFUL_PEAK = np.int32(TrackFlag.FEW_SENSORS), np.int32(TrackFlag.DOUBTFUL_PEAK)
_OUTSIDE_MAP = np.int32(TrackFlag.OUTSIDE_MAP)


def batch_of(
    model: ReadingModel,
    motion: MotionModels,
    tracks: Tracks,
    seen: Seen,
    peaks: FramePeaks,
    time_ns: int,
) -> TrackBatch:
    """Return the tracks, predicted to ``time_ns`` where they were not looked for."""
    states = tracks.states
    late = np.flatnonzero(tracks.time_ns != time_ns)
    if len(late):
        states = states.rows(np.arange(len(tracks)))
        step = np.asarray((time_ns - tracks.time_ns[late]) * 1e-9, dtype=np.float64)
        states.put(late, predicted(motion, tracks.states.rows(late), step))
    whole = combined(motion, states)
    mean, covariance = whole.mean.copy(), whole.covariance.copy()
    if not any(motion.with_acceleration):
        mean[:, 6:] = np.nan
        covariance[:, 6:] = covariance[:, :, 6:] = np.nan
    degrees = seen.degrees()
    used = seen.peaks >= 0
    state = np.where(degrees > 0, _CONFIRMED, _COASTING)
    state *= tracks.confirmed
    flags = seen.merged * _MERGED
    doubt = tracks.uncertain | seen.doubtful | (tracks.weak >= WEAK_EXPOSURES)
    flags |= doubt * _AMBIGUOUS
    flags |= (degrees < 3) * _FEW_SENSORS
    if peaks.flags.any():
        sensor = np.arange(len(model))
        marks = np.where(used, peaks.flags[sensor, np.maximum(seen.peaks, 0)], 0)
        doubtful = (marks & REPORTED).any(axis=1)
        flags |= doubtful * _DOUBTFUL_PEAK
    if model.corrections is not None:
        outside = (used & ~model.vouched(mean[:, :3])).any(axis=1)
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
        np.where(degrees > 0, seen.nis, np.nan),
        degrees,
    )
