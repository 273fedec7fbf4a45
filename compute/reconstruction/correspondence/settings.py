"""MatchSettings and Correspondence: model and limits of grouping, and its result."""

from dataclasses import dataclass
from math import log

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.reconstruction.point_batch import PointBatch

FALSE_REJECTION = 1e-6
"""Chance that the peaks of one marker are not taken together."""


@dataclass(frozen=True)
class MatchSettings:
    """How peaks come about, how sure a group must be, how much work is done for it.

    The first four are a model that has to be right to its order of magnitude only: an exchange of
    peaks leaves them in the balance, and what chance makes is measured in the frame itself.

    Args:
        detection_probability: chance that a sensor has a peak of a marker.
        clutter_density_per_px: density of peaks that are no marker's [1/px].
        markers_per_mm3: density of markers [1/mm^3].
        max_error_rate: largest chance of being wrong with which a group counts as unambiguous.
        max_points: combinations that are reconstructed for a frame, at most.
        max_hypotheses: branches of the enumeration of sets of markers, for each cluster of peaks
            that are linked; beyond, doubt is bounded by linear programmes.

    Raises:
        InvalidParameter: a value out of its range.
    """

    detection_probability: float = 0.95
    clutter_density_per_px: float = 2e-4
    markers_per_mm3: float = 1e-7
    max_error_rate: float = 1e-3
    max_points: int = 200_000
    max_hypotheses: int = 1_000

    def __post_init__(self) -> None:
        for name in ("detection_probability", "max_error_rate"):
            value = getattr(self, name)
            if not 0.0 < value < 1.0:
                raise InvalidParameter(
                    f"{name} is {value}; it must lie between 0 and 1", **{name: value}
                )
        for name in (
            "clutter_density_per_px",
            "markers_per_mm3",
            "max_points",
            "max_hypotheses",
        ):
            value = getattr(self, name)
            if not 0.0 < value < float("inf"):
                raise InvalidParameter(f"{name} is {value}; it must be positive", **{name: value})

    @property
    def log_seen(self) -> float:
        """What a marker's peak adds to its log likelihood, beside being no one's."""
        return log(self.detection_probability) - log(self.clutter_density_per_px)

    @property
    def log_missed(self) -> float:
        """What a sensor without a peak of the marker adds."""
        return log(1.0 - self.detection_probability)

    @property
    def window(self) -> float:
        """Log odds beyond which other sets of markers are not weighed."""
        return 3.0 - log(self.max_error_rate)


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
