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
        step = (time_ns - tracks.time_ns[late]) * 1e-9
        states.put(late, predicted(motion, tracks.states.rows(late), step))
    whole = combined(motion, states)
    mean, covariance = whole.mean.copy(), whole.covariance.copy()
    if not any(motion.with_acceleration):
        mean[:, 6:] = np.nan
        covariance[:, 6:] = covariance[:, :, 6:] = np.nan
    degrees = seen.degrees()
    used = seen.peaks >= 0
    state = np.where(degrees > 0, TrackState.CONFIRMED, TrackState.COASTING)
    state = np.where(tracks.confirmed, state, TrackState.TENTATIVE)
    flags = np.where(seen.merged, TrackFlag.MERGED, 0)
    doubt = tracks.uncertain | seen.doubtful | (tracks.weak >= WEAK_EXPOSURES)
    flags |= np.where(doubt, TrackFlag.AMBIGUOUS, 0)
    flags |= np.where(degrees < 3, TrackFlag.FEW_SENSORS, 0)
    if peaks.flags.any():
        sensor = np.arange(len(model))
        marks = np.where(used, peaks.flags[sensor, np.maximum(seen.peaks, 0)], 0)
        doubtful = (marks & REPORTED).any(axis=1)
        flags |= np.where(doubtful, TrackFlag.DOUBTFUL_PEAK, 0)
    if model.corrections is not None:
        outside = (used & ~model.vouched(mean[:, :3])).any(axis=1)
        flags |= np.where(outside, TrackFlag.OUTSIDE_MAP, 0)
    return TrackBatch(
        tracks.identity.copy(),
        tracks.marker.copy(),
        state.astype(np.int8),
        flags.astype(np.int32),
        mean[:, :3],
        mean[:, 3:6],
        mean[:, 6:],
        covariance,
        seen.peaks,
        np.where(degrees > 0, seen.nis, np.nan),
        degrees,
    )
