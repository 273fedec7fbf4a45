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
        ambiguous_identity: whether the identity is not sure, shape (T,).
        time_ns: of the states, int64, shape (T,).
        seen_ns: when it was last seen beyond doubt, int64, shape (T,).
        hits: exposures that saw an unconfirmed track after its first, int32, shape (T,).
        supported_hits: of these, how many saw it by as many sensors as vouch for a place, int32,
            (T,).
        misses: exposures that did not, int32, shape (T,).
        unsupported: how often, lately, too few sensors saw a confirmed one to vouch for it, int32,
            shape (T,).
        probation_left: exposures in which a confirmed one that came of many peaks must yet be seen
            by as many sensors as vouch for a place, int32, shape (T,).
        log_likelihood_ratio: log likelihood ratio of an unconfirmed track to false peaks, shape
            (T,).
        bias: covariance of the readings' constant errors at ``bias_mm``, shape (T, S, S) [px^2].
        bias_mm: where that was worked out, shape (T, 3).
        neighbours: peaks of markers that are not tracked, beside its own; see ``strangers``, shape
            (T, S, 3).
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
        """Return new tracks, seen now.

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
    """Of T tracks and S sensors.

    Args:
        peaks: index of each sensor's peak; -1: none, int32, shape (T, S).
        merged: whether one of them is shared with another track, shape (T,).
        hypotheses_pruned: whether joint hypotheses were given up that might have mattered, shape
            (T,).
        nis: normalised innovation squared; 0 where nothing was seen, shape (T,).
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
        """Return a copy of some tracks' part."""
        return type(self)(*(getattr(self, field.name)[index] for field in fields(self)))

    def concatenate(self, other: "Associations") -> Self:
        """Return this and another one's tracks after it."""
        return type(self)(
            *(
                np.concatenate([getattr(self, field.name), getattr(other, field.name)])
                for field in fields(self)
            )
        )
