"""Separation of close peaks: valley cut and slope extension, thesis 4.5 and Appendix D."""

import heapq
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from compute.signal.centroid_settings import require_between
from compute.signal.thesis_pipeline.steps import Array, as_scans

_REMOVED: Final = -1


@dataclass(frozen=True, eq=False)
class PeakSegment:
    """One peak taken from a scan, above the zero line.

    Args:
        values: the peak alone, zero elsewhere, shape (P,).
        top_px: pixel of its maximum.
        first_px, last_px: the pixels that were measured, valleys included; what lies beyond is
            extension.
        cut_left, cut_right: whether a valley above zero ends it on that side.
    """

    values: Array
    top_px: int
    first_px: int
    last_px: int
    cut_left: bool
    cut_right: bool


@dataclass(frozen=True)
class ValleyCut:
    """Peaks are cut apart at the lowest pixel of the valley between them: c1 of Table 4.4.

    Steps (I) to (IV) of section 4.5:

    - (I) The zero line lies at a fraction of the scan's greatest value; it is subtracted, and
      what is below becomes zero. (The text says "set a threshold (zero line)", and "zero
      points" for where the curve meets it.)
    - (II) A maximum is a pixel, or a run of equal ones, higher than its neighbours; the middle
      of the run counts.
    - (III) The valley is the lowest pixel between two maxima; of several, the middle one.
    - (IV) A peak reaches from valley to valley, or to the zero points. The pixel of a valley
      belongs to both peaks ("it retained its value").

    Every ripple is a maximum to the text. ``min_depth`` leaves out those of noise: valleys
    that are not deeper below the lower of their maxima than this fraction of it part nothing.

    Args:
        level_fraction: the zero line, as a fraction of the scan's greatest value, 0 to 0.95.
        min_depth: 0 (the text) to 1.

    Raises:
        InvalidParameter: a value outside its range.
    """

    level_fraction: float = 0.2
    min_depth: float = 0.0

    def __post_init__(self) -> None:
        require_between("level_fraction", self.level_fraction, 0.0, 0.95)
        require_between("min_depth", self.min_depth, 0.0, 1.0)

    def separate(self, scan: ArrayLike) -> tuple[PeakSegment, ...]:
        """Separate the peaks of one scan (P,) without background, from left to right."""
        values = as_scans(scan)
        level = self.level_fraction * max(float(values.max()), 0.0)
        return _cut(np.maximum(values - level, 0.0), self.min_depth)


@dataclass(frozen=True)
class SlopeExtension(ValleyCut):
    """Peaks are cut at the valleys, and the cut slopes are continued to zero: c2 of Table 4.4.

    Steps (I) to (IV) are ValleyCut's; then (V) each side that ends at a valley above zero is
    continued by segments. With P the peak's values from the valley's pixel on, P_max its
    maximum, both above the zero line, the segment is

    - (a) ``|P(n_s + 1) - P(n_s)|``, the last difference before the valley, if the valley's value
      is at most P_max / 2;
    - (b) the greatest difference between neighbours on the same side, up to 3/4 P_max;
    - (c) the greatest difference on the opposite side, above.

    The segment is subtracted from pixel to pixel, from the valley's value on (which itself is
    kept, as Appendix D says), and halved whenever it is not smaller than what is left.

    Readings where the text is open:

    - "Applied until its length becomes greater than the value of the current point, otherwise
      the length is set to 1/2 of the last calculated delta", and in Appendix D "continues until
      the value reaches a level small enough": halving goes on until the value is at most
      ``stop_fraction`` of P_max, or the scan ends.
    - The intervals' ends: a value that is exactly 1/2 or 3/4 of P_max belongs to the lower one.
    - Differences are absolute. "Opposite side" is what was measured of it, up to its own valley.
    - A segment of zero (a level valley) would never end: the greatest difference of the same
      side takes its place, then that of the opposite side.
    - (VI) "Placed at their original locations": each peak is a scan of its own; extensions
      reach under their neighbours and are not added up.

    Args:
        stop_fraction: where an extension ends, as a fraction of P_max, 0.0001 to 0.5.

    Raises:
        InvalidParameter: a value outside its range.
    """

    stop_fraction: float = 0.01

    def __post_init__(self) -> None:
        super().__post_init__()
        require_between("stop_fraction", self.stop_fraction, 1e-4, 0.5)

    def separate(self, scan: ArrayLike) -> tuple[PeakSegment, ...]:
        """Separate the peaks of one scan (P,) without background, from left to right."""
        return tuple(self._extend_sides(piece) for piece in super().separate(scan))

    def _extend_sides(self, piece: PeakSegment) -> PeakSegment:
        values = piece.values.copy()
        # Both from the peak's foot to its top.
        left = piece.values[piece.first_px : piece.top_px + 1]
        right = piece.values[piece.top_px : piece.last_px + 1][::-1]
        stop = self.stop_fraction * float(piece.values[piece.top_px])
        if piece.cut_left:
            added = _extension(left, right, stop, piece.first_px)
            values[piece.first_px - len(added) : piece.first_px] = added[::-1]
        if piece.cut_right:
            added = _extension(right, left, stop, len(values) - 1 - piece.last_px)
            values[piece.last_px + 1 : piece.last_px + 1 + len(added)] = added
        return replace(piece, values=values)


def _extension(side: Array, opposite: Array, stop: float, room: int) -> list[float]:
    """Return the values that continue a side beyond its valley, ``side[0]``, at most ``room``."""
    value, delta = float(side[0]), _segment(side, opposite)
    added: list[float] = []
    while len(added) < room and value > stop and delta > 0.0:
        if delta < value:
            # As many at once as stay above zero; the first that is no more than the end is last.
            most = int(min((value - stop) / delta + 2.0, room - len(added)))
            run = value - delta * np.arange(1, most + 1)
            run = run[run > 0.0]
            run = run[: int((run > stop).sum()) + 1]
            added += run.tolist()
            value = added[-1]
        else:
            delta /= 2.0
    return added


def _segment(side: Array, opposite: Array) -> float:
    """Return delta; both sides from the foot to the top."""
    same = float(np.abs(np.diff(side)).max(initial=0.0))
    other = float(np.abs(np.diff(opposite)).max(initial=0.0))
    height = float(side[0]) / float(side[-1])
    if height <= 0.5:
        delta = abs(float(side[1] - side[0]))
    elif height <= 0.75:
        delta = same
    else:
        delta = other
    return delta or same or other


def _cut(scan: Array, min_depth: float) -> tuple[PeakSegment, ...]:
    tops, valleys = _split_at_valleys(scan, min_depth)
    segments = []
    for number, top in enumerate(tops):
        left = valleys[number - 1] if number else None
        right = valleys[number] if number < len(valleys) else None
        first = _foot(scan, top, -1, left)
        last = _foot(scan, top, 1, right)
        values = np.zeros_like(scan)
        values[first : last + 1] = scan[first : last + 1]
        segments.append(PeakSegment(values, top, first, last, first == left, last == right))
    return tuple(segments)


def _split_at_valleys(scan: Array, min_depth: float) -> tuple[list[int], list[int]]:
    """Return the maxima that valleys part, and these valleys.

    The shallowest valley goes first, of equal ones the left one, and with it the lower of its
    maxima; the valley that takes the place of two is found again.
    """
    tops = _maxima(scan)
    count = len(tops)
    before, after = list(range(-1, count - 1)), list(range(1, count + 1))
    valleys = [0] * count  # to the next maximum
    queue: list[tuple[float, int, int]] = []

    def part(left: int, right: int) -> None:
        valleys[left] = _lowest(scan, tops[left], tops[right])
        lower = min(scan[tops[left]], scan[tops[right]])
        heapq.heappush(queue, (float((lower - scan[valleys[left]]) / lower), left, right))

    for left, right in pairwise(range(count)):
        part(left, right)
    while queue and queue[0][0] < min_depth:
        _, left, right = heapq.heappop(queue)
        if after[left] != right:
            continue  # One of the two has gone since.
        # Of two peaks that are one the higher stays.
        removed = left if scan[tops[left]] < scan[tops[right]] else right
        left, right = before[removed], after[removed]
        after[removed] = _REMOVED
        if right < count:
            before[right] = left
        if left >= 0:
            after[left] = right
            if right < count:
                part(left, right)
    stay = [k for k in range(count) if after[k] != _REMOVED]
    return [tops[k] for k in stay], [valleys[k] for k in stay[:-1]]


def _maxima(scan: Array) -> list[int]:
    """Return the pixels higher than their neighbours; the middle of a run of equal ones."""
    starts = np.concatenate([[0], np.flatnonzero(np.diff(scan)) + 1])
    ends = np.concatenate([starts[1:], [len(scan)]])
    level = np.concatenate([[-np.inf], scan[starts], [-np.inf]])
    high = (level[1:-1] > level[:-2]) & (level[1:-1] > level[2:]) & (level[1:-1] > 0.0)
    return [int(pixel) for pixel in ((starts + ends - 1) // 2)[high]]


def _lowest(scan: Array, left: int, right: int) -> int:
    between = scan[left : right + 1]
    lowest = np.flatnonzero(between == between.min())
    return left + int(lowest[len(lowest) // 2])


def _foot(scan: Array, top: int, side: int, valley: int | None) -> int:
    """Return the last pixel of a peak to one side: before the first zero, or the valley's."""
    run = scan[top::side]
    zero = np.flatnonzero(run <= 0.0)
    reach = int(zero[0]) - 1 if zero.size else len(run) - 1
    if valley is not None:
        reach = min(reach, abs(valley - top))
    return top + side * reach
