"""Tracks and Associations: each track's state between exposures, its peaks in one, its report."""

from dataclasses import dataclass, replace
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements
from compute.reconstruction.point_batch import Batch
from compute.tracking.motion_model import CombinedState, ImmStates
from compute.tracking.track_batch import TrackBatch, TrackFlag, TrackState
from compute.tracking.unresolved_neighbours import NEIGHBOUR_FIELDS

Array = NDArray[np.float64]

UNSUPPORTED_EXPOSURES = 5
"""A track with this surplus of exposures without support over those with it may be a ghost."""
MIN_SUPPORT_SENSORS = 4
"""Sensors that support a track: three planes always meet, a fourth excludes most ghosts."""


@dataclass(frozen=True, eq=False)
class Exposure:
    """Measurements of all sensors in one exposure.

    Args:
        time_ns: middle of the exposure [ns].
        peaks: the peaks of the S sensors, up to K each.
        marker: strobe slot that was lit; None: all markers.
    """

    time_ns: int
    peaks: Measurements
    marker: int | None


@dataclass(eq=False)
class Tracks(Batch):
    """T tracks, the oldest first.

    Args:
        states: of motion, each at its own time.
        identity: numbers that are never used again, int64, shape (T,).
        marker: strobe slot; -1: not known, int32, shape (T,).
        confirmed: shape (T,).
        ambiguous_identity: whether the identity is uncertain, shape (T,).
        time_ns: time of the states, int64, shape (T,) [ns].
        last_detection_ns: time of the last certain detection, int64, shape (T,) [ns].
        hits: exposures that saw an unconfirmed track after its first, int32, shape (T,).
        supported_hits: of these, the exposures in which MIN_SUPPORT_SENSORS or more saw it, int32,
            shape (T,).
        misses: exposures that did not see it, int32, shape (T,).
        unsupported: recent exposures in which fewer sensors saw a confirmed track, less those in
            which enough did, int32, shape (T,).
        remaining_probation: exposures in which MIN_SUPPORT_SENSORS or more must still see a
            confirmed track that was initiated among many peaks, int32, shape (T,).
        log_likelihood_ratio: log likelihood ratio of an unconfirmed track to false peaks, shape
            (T,).
        bias: covariance of the readings' constant errors at ``bias_mm``, shape (T, S, S) [px^2].
        bias_mm: position at which that was evaluated, shape (T, 3) [mm].
        neighbours: untracked peaks beside its own, see ``unresolved_neighbours``, shape (T, S, 3).
    """

    states: ImmStates
    identity: NDArray[np.int64]
    marker: NDArray[np.int32]
    confirmed: NDArray[np.bool_]
    ambiguous_identity: NDArray[np.bool_]
    time_ns: NDArray[np.int64]
    last_detection_ns: NDArray[np.int64]
    hits: NDArray[np.int32]
    supported_hits: NDArray[np.int32]
    misses: NDArray[np.int32]
    unsupported: NDArray[np.int32]
    remaining_probation: NDArray[np.int32]
    log_likelihood_ratio: Array
    bias: Annotated[Array, "S", "S"]
    bias_mm: Annotated[Array, 3]
    neighbours: Annotated[Array, "S", NEIGHBOUR_FIELDS]

    @classmethod
    def create(
        cls,
        states: ImmStates,
        bias: Array,
        position_mm: Array,
        *,
        first: int,
        marker: int | None,
        time_ns: int,
        ambiguous_identity: NDArray[np.bool_],
    ) -> Self:
        """Create tentative tracks that were seen in this exposure.

        Args:
            states: of N markers.
            bias: covariance of the readings' constant errors there, shape (N, S, S) [px^2].
            position_mm: shape (N, 3).
            first: number of the first; the others follow.
            marker: strobe slot of them all; None: not known.
            time_ns: of the states.
            ambiguous_identity: whether an identity is not sure, shape (N,).
        """
        count = len(states)
        return replace(
            cls.zeros(count, bias.shape[1]),
            states=states,
            identity=np.arange(first, first + count, dtype=np.int64),
            marker=np.full(count, -1 if marker is None else marker, dtype=np.int32),
            ambiguous_identity=ambiguous_identity.copy(),
            time_ns=np.full(count, time_ns, dtype=np.int64),
            last_detection_ns=np.full(count, time_ns, dtype=np.int64),
            bias=bias,
            bias_mm=position_mm.copy(),
        )

    @property
    def may_be_ghosts(self) -> NDArray[np.bool_]:
        """Mask of tracks that too few sensors have supported lately, shape (T,)."""
        return self.unsupported >= UNSUPPORTED_EXPOSURES

    def update_support(
        self,
        rows: NDArray[np.intp],
        sensor_counts: NDArray[np.integer],
        possible: NDArray[np.integer],
        in_view: NDArray[np.integer],
    ) -> None:
        """Update the counters of exposures with and without MIN_SUPPORT_SENSORS, in place.

        Args:
            rows: of the tracks in view, N of them.
            sensor_counts: how many sensors saw each of them, shape (N,).
            possible: how many saw it or have a peak there that it may share, shape (N,).
            in_view: how many could have, shape (N,).
        """
        unsupported, supported = self.unsupported[rows], sensor_counts >= MIN_SUPPORT_SENSORS
        if not unsupported.any() and supported.all() and not self.remaining_probation.any():
            return
        # A track without any detection is hidden, not contradicted.
        few = (possible < MIN_SUPPORT_SENSORS) & (in_view >= MIN_SUPPORT_SENSORS)
        step = np.where(supported, -1, np.where(few & (sensor_counts > 0), 1, 0))
        self.unsupported[rows] = np.clip(unsupported + step, 0, 2 * UNSUPPORTED_EXPOSURES)
        self.remaining_probation[rows] = np.maximum(self.remaining_probation[rows] - supported, 0)


@dataclass(eq=False)
class Associations(Batch):
    """Peaks that T tracks took of S sensors in one exposure.

    Args:
        peaks: index of each sensor's peak; -1: none, int32, shape (T, S).
        merged: whether one of them is shared with another track, shape (T,).
        hypotheses_pruned: whether joint hypotheses of non-negligible weight were pruned, shape
            (T,).
        nis: normalised innovation squared; 0 where no sensor saw it, shape (T,).
    """

    peaks: Annotated[NDArray[np.int32], "S"]
    merged: NDArray[np.bool_]
    hypotheses_pruned: NDArray[np.bool_]
    nis: Array

    @classmethod
    def missed(cls, tracks: int, sensors: int) -> Self:
        """Return the associations of tracks that no sensor saw.

        Args:
            tracks: number of tracks T.
            sensors: number of sensors S.
        """
        none = np.zeros(tracks, dtype=np.bool_)
        peaks = np.full((tracks, sensors), -1, dtype=np.int32)
        return cls(peaks, none, none.copy(), np.zeros(tracks))

    def sensor_counts(self) -> NDArray[np.int32]:
        """Return how many sensors saw each track, shape (T,)."""
        count: NDArray[np.int32] = (self.peaks >= 0).sum(axis=1).astype(np.int32)
        return count

    def free_peaks(
        self, peaks: Measurements, unreliable: NDArray[np.bool_] | None = None
    ) -> NDArray[np.bool_]:
        """Return the usable peaks that no reliable track explains, shape (S, K).

        Args:
            peaks: measurements of the exposure.
            unreliable: tracks that do not count, shape (T,); None: all count.
        """
        free = peaks.usable.copy()
        explained = self.peaks >= 0
        if unreliable is not None:
            explained &= ~unreliable[:, None]
        track, sensor = np.nonzero(explained)
        free[sensor, self.peaks[track, sensor]] = False
        return free


@dataclass(eq=False)
class AssociationResult:
    """Peaks and updated states of T tracks after an exposure.

    Args:
        states: after the update.
        peaks: index of each sensor's peak; -1: none, int32, shape (T, S).
        merged: whether that peak is shared, shape (T, S).
        probability: probability that it is the track's, 0 where there is none, shape (T, S).
        nis: normalised innovation squared, shape (T,).
        log_likelihood_ratio: of the readings being the track's to being false peaks, shape (T,).
        hypotheses_pruned: whether hypotheses of non-negligible weight were pruned, shape (T,).
        in_view: number of sensors that have the predicted position in view, shape (T,).
    """

    states: ImmStates
    peaks: NDArray[np.int32]
    merged: NDArray[np.bool_]
    probability: Array
    nis: Array
    log_likelihood_ratio: Array
    hypotheses_pruned: NDArray[np.bool_]
    in_view: NDArray[np.int32]

    @classmethod
    def missed(cls, states: ImmStates, sensors: int) -> Self:
        """Return the result where no track has a peak.

        Args:
            states: of T tracks.
            sensors: number of sensors S.
        """
        count, shape = len(states), (len(states), sensors)
        return cls(
            states,
            np.full(shape, -1, np.int32),
            np.zeros(shape, np.bool_),
            np.zeros(shape),
            np.zeros(count),
            np.zeros(count),
            np.zeros(count, np.bool_),
            np.zeros(count, np.int32),
        )


# As arrays' own numbers: an enumeration's operations take as long as an array's. TENTATIVE is 0.
_CONFIRMED, _COASTING = np.int8(TrackState.CONFIRMED), np.int8(TrackState.COASTING)
_MERGED, _AMBIGUOUS, _FEW_SENSORS, _SUSPECT_PEAK, _OUTSIDE_MAP, _NO_COVARIANCE = map(
    np.int32, TrackFlag
)


def to_track_batch(
    model: MeasurementModel,
    tracks: Tracks,
    combined: CombinedState,
    associations: Associations,
    exposure: Exposure,
    *,
    acceleration: bool,
) -> TrackBatch:
    """Return the tracks after an exposure.

    Args:
        model: the measurement model, of S sensors.
        tracks: T tracks.
        combined: their mixtures at the exposure; of which the result takes hold.
        associations: their associations in the exposure.
        exposure: the exposure.
        acceleration: whether it is estimated.
    """
    peaks = exposure.peaks
    mean, covariance = combined.mean, combined.covariance
    if not acceleration:
        mean[:, 6:] = np.nan
        covariance[:, 6:] = covariance[:, :, 6:] = np.nan
    dof = associations.sensor_counts()
    used = associations.peaks >= 0
    state = np.where(dof > 0, _CONFIRMED, _COASTING)
    state *= tracks.confirmed
    flags = associations.merged * _MERGED
    ambiguous = tracks.ambiguous_identity | associations.hypotheses_pruned | tracks.may_be_ghosts
    flags |= ambiguous * _AMBIGUOUS
    flags |= (dof < 3) * _FEW_SENSORS
    if np.count_nonzero(peaks.suspect):
        sensor = np.arange(len(model))
        suspect = used & peaks.suspect[sensor, np.maximum(associations.peaks, 0)]
        flags |= suspect.any(axis=1) * _SUSPECT_PEAK
    if model.corrections is not None:
        outside = (used & ~model.inside_hull(mean[:, :3])).any(axis=1)
        flags |= outside * _OUTSIDE_MAP
        beyond = ~model.in_box(mean[:, :3])
        flags |= beyond * _NO_COVARIANCE
        covariance[beyond] = np.nan
    return TrackBatch(
        tracks.identity.copy(),
        tracks.marker.copy(),
        state,
        flags,
        mean[:, :3],
        mean[:, 3:6],
        mean[:, 6:],
        covariance,
        associations.peaks,
        np.where(dof > 0, associations.nis, np.nan),
        dof,
    )
