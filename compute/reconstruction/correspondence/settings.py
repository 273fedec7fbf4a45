"""MatchSettings: model of peaks and markers for grouping, and limits of the search."""

from dataclasses import dataclass
from math import log

from compute.errors import InvalidParameter

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
