"""Correspondence: readings grouped to markers, with their points."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.reconstruction.point_batch import PointBatch

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Correspondence:
    """Readings grouped to markers.

    Args:
        readings_px: shape (M, S), NaN where a sensor did not see the marker.
        sigma_px: their standard deviations, shape (M, S).
        ambiguous: whether another grouping is likelier than the settings' ``max_error_rate``, or
            not all of them could be weighed; shape (M,).
        points: the points of the groups, solved from these readings, M of them.
        peaks: index of each sensor's peak, in the order given, -1: none; shape (M, S).
        predicted: index of the predicted point that it is, -1: none; shape (M,).
        body: index of the rigid body that it belongs to, -1: none; shape (M,).
        body_marker: which marker of that body it is, -1: none; shape (M,).
        cut: combinations and sets that were not looked at because there were too many; where this
            is not 0, the groups that they might have changed are ambiguous.
    """

    readings_px: Array
    sigma_px: Array
    ambiguous: NDArray[np.bool_]
    points: PointBatch
    peaks: NDArray[np.intp]
    predicted: NDArray[np.intp]
    body: NDArray[np.intp]
    body_marker: NDArray[np.intp]
    cut: int

    def __len__(self) -> int:
        """Return the number of groups."""
        return len(self.readings_px)


@dataclass(frozen=True)
class Group:
    """A marker's peaks: their indices by sensor, -1: none; see ``Correspondence``."""

    choice: tuple[int, ...]
    ambiguous: bool
    predicted: int = -1
    body: int = -1
    body_marker: int = -1
