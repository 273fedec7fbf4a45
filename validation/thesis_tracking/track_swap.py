"""Probability that two targets swap their tracks, [6.9] and [6.10]."""

from collections.abc import Sequence
from enum import Enum
from math import log, sqrt
from typing import Final, Literal

from scipy.special import ndtr

from validation.thesis_tracking.intervals import PositionInterval

Density = Literal["normal", "even"]
"""The probability density of a target's position: ``swap_probability`` says what each is."""

SWAP_THRESHOLD: Final = 0.5
"""Section 6.2.2: "a probability threshold, for example 0.5"."""

INTERVAL_SIGMA: Final = 2.0
"""An interval reaches two standard deviations to either side [6.7]."""


class Transition(Enum):
    """What a pair's probabilities of successive scans say, section 6.2.2."""

    KEEP = "keep"
    """None of the others: "the target should not change its state"."""
    MERGE = "merge"
    """Two targets from different tracks occupy the same track: from below the threshold to it."""
    SPLIT = "split"
    """Two targets from the same track split into separate ones: from the threshold to below."""
    CROSS = "cross"
    """Two targets have their tracks cross over: below, not below in one scan, and below again."""


def swap_probability(
    one: PositionInterval, other: PositionInterval, density: Density = "normal"
) -> float:
    """Return [6.9], intersection over union of two targets' probability, 0 to 1.

    ``P = (P_n and P_k) / (P_n + P_k - P_n and P_k)``. The text calls P_n and P_k densities, and
    their intersection an area (Figures 6.10, 6.11), so:

    - "normal": densities normal about the intervals' middles, with half their half widths for
      standard deviations; the intersection is the area under both, each alone having 1.
    - "even": densities even over the intervals, not scaled to area 1: the intervals' common
      length over their joint length. This is [6.9] "through their position intervals", what
      [6.10] wants to be.

    [6.10] as printed is neither. ``X(n) - dX(k) - (dX(n) - dX(k)) / 2`` is ``X(n) - (dX(n) +
    dX(k)) / 2``: a place on the sensor [px] and no probability, in which the other target's
    position X(k) does not occur. For intervals of one width it is the lower end of target n's,
    where the common part begins. ``printed_6_10`` gives it for comparison.

    Args:
        one, other: where the targets may be.
        density: of the positions.
    """
    if density == "even":
        return _of_intervals(one, other)
    common = _common_area(
        one.centre_px,
        one.half_width_px / INTERVAL_SIGMA,
        other.centre_px,
        other.half_width_px / INTERVAL_SIGMA,
    )
    return common / (2.0 - common)


def printed_6_10(one: PositionInterval, other: PositionInterval) -> float:
    """Return [6.10] as printed [px], of targets n and k: see ``swap_probability``."""
    difference = one.half_width_px - other.half_width_px
    return one.centre_px - other.half_width_px - difference / 2.0


def transition(probabilities: Sequence[float], threshold: float = SWAP_THRESHOLD) -> Transition:
    """Return what the probabilities of a pair say in the last scan, by the three before it.

    A crossing shows only when it is over: in the scan before, the two were on the same track.

    Args:
        probabilities: of successive scans, the last one last; of earlier ones than these, the
            pair was apart.
        threshold: at it and above, two targets are on the same track.
    """
    before, centre, now = [p >= threshold for p in (0.0, 0.0, 0.0, *probabilities)[-3:]]
    if now:
        return Transition.KEEP if centre else Transition.MERGE
    if not centre:
        return Transition.KEEP
    return Transition.SPLIT if before else Transition.CROSS


def _of_intervals(one: PositionInterval, other: PositionInterval) -> float:
    low = max(one.centre_px - one.half_width_px, other.centre_px - other.half_width_px)
    high = min(one.centre_px + one.half_width_px, other.centre_px + other.half_width_px)
    common = max(high - low, 0.0)
    joint = 2.0 * (one.half_width_px + other.half_width_px) - common
    return min(common / joint, 1.0)


def _common_area(mean: float, deviation: float, other_mean: float, other_deviation: float) -> float:
    """Return the area under both of two normal densities, 0 to 1."""
    if deviation > other_deviation:
        mean, deviation, other_mean, other_deviation = other_mean, other_deviation, mean, deviation
    # In the narrower one's deviations, its middle at 0.
    apart, wide = abs(other_mean - mean) / deviation, other_deviation / deviation
    excess = (wide - 1.0) * (wide + 1.0)
    if excess < 1e-9:
        return 2.0 * float(ndtr(-apart / 2.0))
    # The densities are equal at the roots of excess z^2 + 2 apart z - (apart^2 + 2 wide^2 ln wide).
    constant = apart**2 + 2.0 * wide**2 * log(wide)
    root = sqrt(apart**2 + excess * constant)
    high = constant / (apart + root)
    low = -(apart + root) / excess
    narrow_outside = float(ndtr(low) + ndtr(-high))
    wide_inside = float(ndtr((high - apart) / wide) - ndtr((low - apart) / wide))
    return min(narrow_outside + wide_inside, 1.0)
