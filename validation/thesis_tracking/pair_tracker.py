"""Tracking of two targets along one sensor, scan by scan, section 6.1.3."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isnan
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from validation.thesis_tracking.quadratic_window import QuadraticWindow

Array = NDArray[np.float64]

Decision = Literal["velocity", "prediction"]
"""How a track's subset is chosen; ``PairTracking`` says what each is."""


@dataclass(frozen=True)
class PairPoint:
    """What a track takes in one scan.

    Args:
        position_px: of its point.
        predicted_px: by the quadratic window, from the points before.
        subset: that the point is from, 0 or 1.
        created: whether the point was made up (gap filling).
    """

    position_px: float
    predicted_px: float
    subset: int
    created: bool


class PairTracker:
    """What ``PairTracking`` does, one scan at a time: nothing of it looks ahead.

    "It could be used in on-line procedures as well": only as many points as the window has are
    kept of each subset and track.

    Args:
        first_px: the points that the tracks begin with, Track 1's in Subset 1, (2,).
        velocity_limit_px_s: delta: ``PairTracking``.
        window: of gap filling and prediction.
        decision: how a track's subset is chosen.
        before_px: points of each subset before the first ones, for the window; None: none.
    """

    def __init__(
        self,
        first_px: Array,
        velocity_limit_px_s: float,
        window: QuadraticWindow,
        decision: Decision = "velocity",
        before_px: tuple[Sequence[float], Sequence[float]] | None = None,
    ) -> None:
        self._limit_px_s = velocity_limit_px_s
        self._window = window
        self._decision = decision
        before = ((), ()) if before_px is None else before_px
        self._subsets = [[*before[one], float(first_px[one])] for one in range(2)]
        self._tracks = [list(subset) for subset in self._subsets]
        self._current = [0, 1]

    def step(self, subsets_px: Array, interval_s: float) -> tuple[PairPoint, PairPoint]:
        """Return the points of both tracks in the next scan.

        Args:
            subsets_px: the point of each subset, NaN where it is missing, (2,).
            interval_s: the sampling period.
        """
        points, made = [float(one) for one in subsets_px], [False, False]
        for one, history in enumerate(self._subsets):
            if isnan(points[one]):
                points[one], made[one] = self._window.next_position(history), True
            self._put(history, points[one])
        first, second = (self._follow(track, points, made, interval_s) for track in range(2))
        return first, second

    def _follow(
        self, track: int, points: list[float], made: list[bool], interval_s: float
    ) -> PairPoint:
        history = self._tracks[track]
        expected = self._window.next_position(history)
        current = self._current[track]
        if self._switches_subset(points, current, history, expected, interval_s):
            current = 1 - current
        self._current[track] = current
        self._put(history, points[current])
        return PairPoint(points[current], expected, current, made[current])

    def _switches_subset(
        self,
        points: list[float],
        current: int,
        history: list[float],
        expected: float,
        interval_s: float,
    ) -> bool:
        if self._decision == "prediction":
            return abs(points[1 - current] - expected) < abs(points[current] - expected)
        if len(history) < 2:
            return False
        before = (history[-1] - history[-2]) / interval_s
        now = (points[current] - history[-1]) / interval_s
        return before * now < 0.0 and abs(now - before) > self._limit_px_s

    def _put(self, history: list[float], position_px: float) -> None:
        history.append(position_px)
        del history[: -max(self._window.points, 2)]
