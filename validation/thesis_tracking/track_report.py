"""A marker of the thesis's trackers as a track of a TrackBatch."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurements import Measurements
from compute.tracking.track_batch import TrackBatch, TrackFlag, TrackState

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TrackReport:
    """A marker at one instant; fields as of ``TrackBatch``, of one track.

    Args:
        identity: number.
        marker: strobe slot; -1: none.
        tentative: whether it was seen too few times yet.
        mean: position, velocity, acceleration, shape (9,).
        covariance: of these, shape (9, 9).
        peaks: index of each sensor's peak; -1: none, shape (S,).
        flags: those that the peaks do not tell.
        nis: normalised innovation squared; NaN: the method has none.
        dof: of ``nis``.
    """

    identity: int
    marker: int
    tentative: bool
    mean: Array
    covariance: Array
    peaks: NDArray[np.int32]
    flags: TrackFlag = TrackFlag.NONE
    nis: float = float("nan")
    dof: int = 0


def reports_to_track_batch(reports: Sequence[TrackReport], peaks: Measurements) -> TrackBatch:
    """Return markers as tracks, the oldest first."""
    sensors = len(peaks.position_px)
    if not reports:
        return TrackBatch.empty(sensors)
    ordered = sorted(reports, key=lambda one: one.identity)
    taken = np.stack([one.peaks for one in ordered])
    used = taken >= 0
    count = used.sum(axis=1)
    tentative = np.array([one.tentative for one in ordered])
    state = np.where(count > 0, TrackState.CONFIRMED, TrackState.COASTING)
    flags = np.array([int(one.flags) for one in ordered], dtype=np.int32)
    flags |= np.where(count < 3, np.int32(TrackFlag.FEW_SENSORS), np.int32(0))
    if np.count_nonzero(peaks.suspect):
        suspect = (used & peaks.suspect[np.arange(sensors), np.maximum(taken, 0)]).any(axis=1)
        flags |= np.where(suspect, np.int32(TrackFlag.SUSPECT_PEAK), np.int32(0))
    mean = np.stack([one.mean for one in ordered])
    return TrackBatch(
        np.array([one.identity for one in ordered], dtype=np.int64),
        np.array([one.marker for one in ordered], dtype=np.int32),
        np.where(tentative, TrackState.TENTATIVE, state).astype(np.int8),
        flags,
        mean[:, :3],
        mean[:, 3:6],
        mean[:, 6:],
        np.stack([one.covariance for one in ordered]),
        taken.astype(np.int32),
        np.array([one.nis for one in ordered]),
        np.array([one.dof for one in ordered], dtype=np.int32),
    )
