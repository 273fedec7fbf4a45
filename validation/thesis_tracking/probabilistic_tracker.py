"""Probabilistic association of targets with tracks along one sensor, section 6.2.2."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linear_sum_assignment

from compute.errors import InvalidParameter
from validation.thesis_tracking.intervals import (
    IntervalSettings,
    PositionInterval,
    position_interval,
    velocity_estimate,
)
from validation.thesis_tracking.sensor_point import SensorPoint
from validation.thesis_tracking.sensor_track import GrowingTrack, SensorTrack, TrackEnd
from validation.thesis_tracking.track_pairs import PairState, TrackPairs
from validation.thesis_tracking.track_swap import (
    INTERVAL_SIGMA,
    SWAP_THRESHOLD,
    Density,
    Transition,
)

Array = NDArray[np.float64]
Pairs = Mapping[tuple[int, int], PairState]

_NEVER: Final = 1e9  # the cost of a point outside the interval


@dataclass(frozen=True)
class AssociationSettings:
    """The probabilistic model of section 6.2.2.

    Args:
        interval: where a target may be in the next scan.
        interval_s: the sampling period [s]; scans are taken as equally far apart.
        threshold: probability from which on two targets are on the same track, 0 to 1.
        density: of [6.9].
        young_scans: a track seen in fewer scans is young: "three successive scans" decide on a
            target's state.
        coast_scans: scans in a row that an older track outlives without a point, by the dynamic
            model; the text ends a track "with the target's disappearance" and gives no number.

    Raises:
        InvalidParameter: a value outside its range.
    """

    interval: IntervalSettings
    interval_s: float
    threshold: float = SWAP_THRESHOLD
    density: Density = "normal"
    young_scans: int = 3
    coast_scans: int = 6

    def __post_init__(self) -> None:
        if not (isfinite(self.interval_s) and self.interval_s > 0.0):
            raise InvalidParameter(
                f"interval_s is {self.interval_s}; it must be above zero and finite",
                interval_s=self.interval_s,
            )
        if not 0.0 < self.threshold < 1.0:
            raise InvalidParameter(
                f"threshold is {self.threshold}; it must lie between 0 and 1",
                threshold=self.threshold,
            )
        for name, least in (("young_scans", 1), ("coast_scans", 0)):
            value = getattr(self, name)
            if value < least:
                raise InvalidParameter(
                    f"{name} is {value}; it must be {least} or more", **{name: value}
                )


@dataclass(frozen=True)
class _Expected:
    """Where a track's target is by [6.2], and where it may be."""

    position_px: float
    interval: PositionInterval


class ProbabilisticTracker:
    """Follows the targets of one sensor from scan to scan.

    In each scan:

    - Each track has an interval in which its target may be ([6.7], [6.8]) and each pair of
      tracks a probability to exchange their targets [6.9], both from the scans before. After
      scans without a point the interval goes on from the last one, over all the time since.
    - Where a young track comes on the same track as an older one, it ends: "false" targets have
      a high probability of exchanging tracks and a low one of keeping theirs, "which would
      ultimately result in their termination".
    - Points go to the tracks in whose interval they are, so that the distances to the predicted
      positions are least in all. Two tracks that are one by the threshold share a point, where
      there is only one.
    - Where two older tracks crossed (``Transition.CROSS``), their points are on exchanged sides,
      and are swapped if they are not. Where two split, the dynamic model decides, as the text
      does not.
    - A point that no track takes begins a track of its own, in the first scan and later. A young
      track without a point ends at once, an older one after ``coast_scans``.

    Args:
        settings: the model.
    """

    def __init__(self, settings: AssociationSettings) -> None:
        self.settings = settings
        self._interval_s = settings.interval_s
        self._scan = 0
        self._begun = 0
        self._live: dict[int, GrowingTrack] = {}
        self._ended: list[SensorTrack] = []
        self._pairs = TrackPairs(settings.threshold, settings.density)

    def step(
        self, position_px: ArrayLike, interval_s: float | None = None
    ) -> tuple[SensorPoint, ...]:
        """Associate the points of the next scan; return where each running track is now.

        Args:
            position_px: shape (K,) [px]; NaN: none.
            interval_s: the sampling period as it is now; None: that of the settings, or the last
                one that was given.
        """
        if interval_s is not None:
            self._interval_s = interval_s
        given = np.asarray(position_px, dtype=np.float64).ravel()
        order = np.argsort(given, kind="stable")[: int((~np.isnan(given)).sum())].tolist()
        points = given[order].tolist()
        expected = {number: self._expected(track) for number, track in self._live.items()}
        pairs = self._pairs.step({number: one.interval for number, one in expected.items()})
        self._end_absorbed(pairs)
        expected = {number: expected[number] for number in self._live}
        pairs = {key: state for key, state in pairs.items() if set(key) <= set(self._live)}
        taken = _assigned(points, expected)
        shared = _shared(taken, points, expected, pairs)
        self._swap_crossed(taken, pairs)
        for number, track in self._live.items():
            point = shared.get(number, taken.get(number))
            if point is None:
                track.add(expected[number].position_px, seen=False, shared=False)
            else:
                track.add(points[point], seen=True, shared=point in shared.values())
        self._end_missed()
        found = [
            self._point(number, shared.get(number, taken.get(number)), expected[number], order)
            for number in self._live
        ]
        for point in sorted(set(range(len(points))) - set(taken.values())):
            self._live[self._begun] = GrowingTrack(self._begun, self._scan, points[point])
            found.append(SensorPoint(self._begun, points[point], order[point], 1))
            self._begun += 1
        self._scan += 1
        return tuple(found)

    def forget(self) -> None:
        """Forget ended tracks, and of running ones all that no later scan needs.

        For those who follow for hours; ``tracks`` then has what is left.
        """
        self._ended.clear()
        needed = max(self.settings.interval.scans + 1, self.settings.coast_scans + 2)
        for track in self._live.values():
            track.forget(needed)

    def tracks(self) -> tuple[SensorTrack, ...]:
        """Return all tracks so far, ended ones too, by their numbers."""
        running = (track.finished(TrackEnd.RUNNING) for track in self._live.values())
        return tuple(sorted([*self._ended, *running], key=lambda track: track.number))

    def _point(
        self, number: int, point: int | None, expected: _Expected, order: list[int]
    ) -> SensorPoint:
        track = self._live[number]
        if point is None:
            deviation = expected.interval.half_width_px / INTERVAL_SIGMA
            return SensorPoint(number, track.position_px[-1], -1, track.life, deviation)
        shared = track.is_shared
        return SensorPoint(number, track.position_px[-1], order[point], track.life, 0.0, shared)

    def _expected(self, track: GrowingTrack) -> _Expected:
        given = self.settings
        recent = np.array(track.position_px[-given.interval.scans - 1 :])
        velocity = velocity_estimate(recent, self._interval_s, given.interval)
        last = track.position_px[-1 - track.missed]
        since_s = (1 + track.missed) * self._interval_s
        return _Expected(
            last + velocity.mean_px_s * since_s,
            position_interval(last, velocity, since_s, given.interval),
        )

    def _young(self, number: int) -> bool:
        return self._live[number].life < self.settings.young_scans

    def _end(self, number: int, how: TrackEnd) -> None:
        self._ended.append(self._live.pop(number).finished(how))

    def _end_absorbed(self, pairs: Pairs) -> None:
        """End young tracks that came on an older one's."""
        gone = set()
        for (first, second), state in pairs.items():
            if state.together and self._young(first) != self._young(second):
                gone.add(first if self._young(first) else second)
        for number in sorted(gone):
            self._end(number, TrackEnd.ABSORBED)

    def _swap_crossed(self, taken: dict[int, int], pairs: Pairs) -> None:
        """Swap the points of older tracks that crossed and are on their old sides."""
        for (first, second), state in pairs.items():
            if state.transition is not Transition.CROSS or state.side == 0.0:
                continue
            if first not in taken or second not in taken:
                continue
            if self._young(first) or self._young(second):
                continue
            # Points are numbered from left to right.
            if np.sign(taken[second] - taken[first]) == state.side:
                taken[first], taken[second] = taken[second], taken[first]

    def _end_missed(self) -> None:
        for number, track in list(self._live.items()):
            if track.missed and self._young(number):
                self._end(number, TrackEnd.SHORT_LIFE)
            elif track.missed > self.settings.coast_scans:
                self._end(number, TrackEnd.LOST)


def _assigned(points: list[float], expected: Mapping[int, _Expected]) -> dict[int, int]:
    """Return the point of each track that has one."""
    if not points or not expected:
        return {}
    cost = np.array(
        [
            [abs(x - one.position_px) if x in one.interval else _NEVER for x in points]
            for one in expected.values()
        ]
    )
    numbers = list(expected)
    rows, columns = linear_sum_assignment(cost)
    return {
        numbers[row]: int(column)
        for row, column in zip(rows.tolist(), columns.tolist(), strict=True)
        if cost[row, column] < _NEVER
    }


def _shared(
    taken: Mapping[int, int],
    points: list[float],
    expected: Mapping[int, _Expected],
    pairs: Pairs,
) -> dict[int, int]:
    """Return the points that two tracks share, by both tracks."""
    shared: dict[int, int] = {}
    for key, state in pairs.items():
        having = [number for number in key if number in taken]
        if not state.together or len(having) != 1:
            continue
        point = taken[having[0]]
        if all(points[point] in expected[number].interval for number in key):
            shared.update(dict.fromkeys(key, point))
    return shared
