"""Associations: the peaks that each track took in one exposure."""

from dataclasses import dataclass, fields
from typing import Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


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
        """Return that nothing was seen."""
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
