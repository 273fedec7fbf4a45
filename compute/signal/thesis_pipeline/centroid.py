"""Centre of gravity [4.1] of a peak in a filtered scan, with its derivatives."""

from dataclasses import dataclass

import numpy as np

from compute.signal.centroid_settings import Weighting
from compute.signal.thesis_pipeline.steps import Array


@dataclass(frozen=True, eq=False)
class Centroid:
    """The centre of gravity of one peak.

    Args:
        position_px: the centre [px].
        first_px, last_px: ends of the run of pixels above the peak's threshold.
        width_px: the run's width, interpolated between pixels [px].
        derivative: of the position by each value of the scan, shape (P,) [px/count].
    """

    position_px: float
    first_px: int
    last_px: int
    width_px: float
    derivative: Array


def centre_of_gravity(scan: Array, top_px: int, fraction: float, weighting: Weighting) -> Centroid:
    """Return the centre of gravity [4.1] of the run around a maximum, above its own threshold.

    The threshold is ``T = fraction * P_max``; the run is the pixels around the maximum with
    values above it. "above-threshold" weighs ``P - T``, as thesis 4.2.2 says ("a threshold of
    1/3 of the peak maximum value was subtracted"), "above-background" weighs P, as [4.1] stands,
    "edge-corrected" adds what the sum lacks of the integral at the run's ends: CentroidSettings.

    The derivative goes through the threshold and the interpolated ends; which pixels belong to
    the run is taken as given.

    Args:
        scan: values above the background, shape (P,).
        top_px: the pixel of the maximum, whose value must be positive.
        fraction: 0 to below 1.
        weighting: what is weighed.
    """
    top = float(scan[top_px])
    threshold = fraction * top
    low = np.flatnonzero(scan[:top_px] <= threshold)
    high = np.flatnonzero(scan[top_px + 1 :] <= threshold)
    first = int(low[-1]) + 1 if low.size else 0
    last = top_px + int(high[0]) if high.size else len(scan) - 1
    base = 0.0 if weighting == "above-background" else threshold
    # Relative to the maximum: far from the first pixel digits would be lost.
    arms = np.arange(first, last + 1, dtype=np.float64) - top_px
    weights = scan[first : last + 1] - base
    ends = [
        _SegmentEnd(scan, end, side, threshold, top_px)
        for end, side in ((first, -1), (last, 1))
        if 0 <= end + side < len(scan)
    ]
    corrected = ends if weighting == "edge-corrected" else []
    total = float(weights.sum()) + sum(end.excess for end in corrected)
    moment = float(arms @ weights) + sum(end.excess * end.position_px for end in corrected)
    centre = moment / total

    derivative = np.zeros_like(scan)
    derivative[first : last + 1] = arms - centre
    by_threshold = 0.0 if weighting == "above-background" else -float((arms - centre).sum())
    for end in corrected:
        arm = end.position_px - centre
        by_value = end.excess_by_value * arm + end.excess * end.side / end.slope
        by_slope = end.excess_by_slope * arm - end.excess * end.side * end.inside / end.slope
        derivative[end.pixel] += by_value + by_slope
        derivative[end.pixel + end.side] -= by_slope
        by_threshold -= by_value
    derivative[top_px] += fraction * by_threshold

    left = next((e.position_px for e in ends if e.side < 0), first - top_px - 0.5)
    right = next((e.position_px for e in ends if e.side > 0), last - top_px + 0.5)
    return Centroid(top_px + centre, first, last, right - left, derivative / total)


class _SegmentEnd:
    """An end of the run: where the scan falls through the threshold, and the sum's excess there.

    With a the last value above the threshold and s the slope beyond it, the first term of Euler
    and Maclaurin's formula is ``(a^2/s - a + s/6) / 2``.
    """

    def __init__(self, scan: Array, pixel: int, side: int, threshold: float, top_px: int) -> None:
        above = float(scan[pixel]) - threshold
        self.pixel, self.side = pixel, side
        self.slope = float(scan[pixel] - scan[pixel + side])
        self.inside = above / self.slope
        self.position_px = pixel - top_px + side * self.inside
        self.excess = 0.5 * (above * self.inside - above + self.slope / 6.0)
        self.excess_by_value = self.inside - 0.5
        self.excess_by_slope = 0.5 * (1.0 / 6.0 - self.inside**2)
