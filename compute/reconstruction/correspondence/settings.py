"""MatchSettings and Correspondence: model and limits of grouping, and its result."""

from dataclasses import dataclass
from math import log

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.reconstruction.point_batch import PointBatch

Array = NDArray[np.float64]

FALSE_REJECTION = 1e-6
"""Probability that the peaks of one marker are not grouped."""


@dataclass(frozen=True)
class MatchSettings:
    """Model of peaks and markers, accepted error rate, and limits of the search.

    The first three need only the right order of magnitude: they cancel where two markers exchange
    peaks, and the density of chance intersections is measured in the frame itself.

    Args:
        detection_probability: probability that a sensor has a peak of a marker.
        clutter_density_per_px: density of false peaks [1/px].
        markers_per_mm3: density of markers [1/mm^3].
        max_error_rate: largest error probability of a group that counts as unambiguous.
        max_points: most combinations that are reconstructed in a frame.
        max_hypotheses: most branches of the enumeration of sets of markers, for each cluster of
            linked peaks; beyond, error probabilities are bounded by linear programmes.

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
        """Log likelihood ratio of a detected marker's peak to a false peak [log px]."""
        return log(self.detection_probability) - log(self.clutter_density_per_px)

    @property
    def log_missed(self) -> float:
        """Log likelihood of a missed detection."""
        return log(1.0 - self.detection_probability)

    @property
    def window(self) -> float:
        """Log odds beyond which other sets of markers are not enumerated."""
        return 3.0 - log(self.max_error_rate)


@dataclass(frozen=True, eq=False)
class Correspondence:
    """Readings grouped to markers.

    Args:
        readings_px: shape (M, S), NaN where a sensor did not see the marker.
        sigma_px: their standard deviations, shape (M, S).
        ambiguous: whether another grouping is likelier than the settings' ``max_error_rate``, or
            the search was cut; shape (M,).
        points: the points of the groups, solved from these readings, M of them.
        peaks: index of each sensor's peak, in the order given, -1: none; shape (M, S).
        predicted: index of the predicted point that it is, -1: none; shape (M,).
        body: index of the rigid body that it belongs to, -1: none; shape (M,).
        body_marker: which marker of that body it is, -1: none; shape (M,).
        cut: combinations and sets that were not examined because there were too many; where this
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
