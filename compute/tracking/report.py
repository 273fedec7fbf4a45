"""to_track_batch: the tracks after an exposure as a TrackBatch."""

import numpy as np

from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements
from compute.tracking.associations import Associations
from compute.tracking.imm_states import combine_modes, mix_and_predict
from compute.tracking.motion_model import MotionModels
from compute.tracking.track_batch import TrackBatch, TrackFlag, TrackState
from compute.tracking.track_management import UNSUPPORTED_EXPOSURES
from compute.tracking.tracks import Tracks

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
    """Return the tracks, predicted to ``time_ns`` where they were not looked for."""
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
