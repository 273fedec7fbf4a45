"""Tracks and Associations: each track's state between exposures, and its peaks in one."""

from dataclasses import dataclass, fields
from typing import Self

import numpy as np
from numpy.typing import NDArray

from compute.tracking.motion_model import ImmStates
from compute.tracking.unresolved_neighbours import NEIGHBOUR_FIELDS

Array = NDArray[np.float64]


@dataclass(eq=False)
class Tracks:
    """T tracks, the oldest first.

    Args:
        states: of motion, each at its own time.
        identity: numbers that are never used again, int64, shape (T,).
        marker: strobe slot; -1: not known, int32, shape (T,).
        confirmed: shape (T,).
        ambiguous_identity: whether the identity is uncertain, shape (T,).
        time_ns: time of the states, int64, shape (T,) [ns].
        seen_ns: time at which it was last seen with certainty, int64, shape (T,) [ns].
        hits: exposures that saw an unconfirmed track after its first, int32, shape (T,).
        supported_hits: of these, the exposures in which MIN_SUPPORT_SENSORS or more saw it, int32,
            shape (T,).
        misses: exposures that did not see it, int32, shape (T,).
        unsupported: recent exposures in which fewer sensors saw a confirmed track, less those in
            which enough did, int32, shape (T,).
        probation_left: exposures in which MIN_SUPPORT_SENSORS or more must still see a confirmed
            track that was initiated among many peaks, int32, shape (T,).
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
    seen_ns: NDArray[np.int64]
    hits: NDArray[np.int32]
    supported_hits: NDArray[np.int32]
    misses: NDArray[np.int32]
    unsupported: NDArray[np.int32]
    probation_left: NDArray[np.int32]
    log_likelihood_ratio: Array
    bias: Array
    bias_mm: Array
    neighbours: Array

    @classmethod
    def empty(cls, models: int, sensors: int) -> Self:
        """Return no tracks.

        Args:
            models: number of motion models M.
            sensors: number of sensors S.
        """
        return cls(
            ImmStates.empty(models, sensors),
            np.empty(0, np.int64),
            np.empty(0, np.int32),
            np.empty(0, np.bool_),
            np.empty(0, np.bool_),
            np.empty(0, np.int64),
            np.empty(0, np.int64),
            np.empty(0, np.int32),
            np.empty(0, np.int32),
            np.empty(0, np.int32),
            np.empty(0, np.int32),
            np.empty(0, np.int32),
            np.empty(0),
            np.empty((0, sensors, sensors)),
            np.empty((0, 3)),
            np.empty((0, sensors, NEIGHBOUR_FIELDS)),
        )

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
        confirmed: bool,
        ambiguous_identity: NDArray[np.bool_],
    ) -> Self:
        """Create tracks that were seen in this exposure.

        Args:
            states: of N markers.
            bias: covariance of the readings' constant errors there, shape (N, S, S) [px^2].
            position_mm: shape (N, 3).
            first: number of the first; the others follow.
            marker: strobe slot of them all; None: not known.
            time_ns: of the states.
            confirmed: whether they are markers for sure.
            ambiguous_identity: whether an identity is not sure, shape (N,).
        """
        count = len(states)
        return cls(
            states,
            np.arange(first, first + count, dtype=np.int64),
            np.full(count, -1 if marker is None else marker, dtype=np.int32),
            np.full(count, confirmed, dtype=np.bool_),
            ambiguous_identity.copy(),
            np.full(count, time_ns, dtype=np.int64),
            np.full(count, time_ns, dtype=np.int64),
            np.zeros(count, dtype=np.int32),
            np.zeros(count, dtype=np.int32),
            np.zeros(count, dtype=np.int32),
            np.zeros(count, dtype=np.int32),
            np.zeros(count, dtype=np.int32),
            np.zeros(count),
            bias,
            position_mm.copy(),
            np.zeros((count, bias.shape[1], NEIGHBOUR_FIELDS)),
        )

    def __len__(self) -> int:
        """Return the number of tracks."""
        return len(self.identity)

    def rows(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> Self:
        """Return a copy of some tracks."""
        return type(self)(
            self.states.rows(index),
            *(getattr(self, field.name)[index] for field in fields(self)[1:]),
        )

    def concatenate(self, other: "Tracks") -> Self:
        """Return these tracks and others after them."""
        return type(self)(
            self.states.concatenate(other.states),
            *(
                np.concatenate([getattr(self, field.name), getattr(other, field.name)])
                for field in fields(self)[1:]
            ),
        )


@dataclass(eq=False)
class Associations:
    """Peaks that T tracks took of S sensors in one exposure.

    Args:
        peaks: index of each sensor's peak; -1: none, int32, shape (T, S).
        merged: whether one of them is shared with another track, shape (T,).
        hypotheses_pruned: whether joint hypotheses of non-negligible weight were pruned, shape
            (T,).
        nis: normalised innovation squared; 0 where no sensor saw it, shape (T,).
    """

    peaks: NDArray[np.int32]
    merged: NDArray[np.bool_]
    hypotheses_pruned: NDArray[np.bool_]
    nis: Array

    @classmethod
    def empty(cls, tracks: int, sensors: int) -> Self:
        """Return the associations of tracks that no sensor saw.

        Args:
            tracks: number of tracks T.
            sensors: number of sensors S.
        """
        return cls(
            np.full((tracks, sensors), -1, dtype=np.int32),
            np.zeros(tracks, dtype=np.bool_),
            np.zeros(tracks, dtype=np.bool_),
            np.zeros(tracks),
        )

    def sensor_counts(self) -> NDArray[np.int32]:
        """Return how many sensors saw each track, shape (T,)."""
        count: NDArray[np.int32] = (self.peaks >= 0).sum(axis=1).astype(np.int32)
        return count

    def rows(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> Self:
        """Return a copy of some tracks' associations."""
        return type(self)(*(getattr(self, field.name)[index] for field in fields(self)))

    def concatenate(self, other: "Associations") -> Self:
        """Return these associations and others after them."""
        return type(self)(
            *(
                np.concatenate([getattr(self, field.name), getattr(other, field.name)])
                for field in fields(self)
            )
        )
