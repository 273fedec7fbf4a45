"""Window tracker of section 6.1.3 on one sensor, exposure by exposure."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from validation.thesis_tracking.pair_tracker import PairTracker
from validation.thesis_tracking.quadratic_window import QuadraticWindow
from validation.thesis_tracking.sensor_point import SensorPoint
from validation.thesis_tracking.settings import ThesisSettings
from validation.thesis_tracking.subsets import SubsetOrder

Array = NDArray[np.float64]


class _Target:
    """A track along the sensor, as far as the window and the next scan need it."""

    def __init__(self, number: int, position_px: float, deviation_px: float) -> None:
        self.number = number
        self.position_px = [position_px]
        self.deviation_px = [deviation_px]
        self.seen_px = position_px  # its last point that was seen
        self.missed = 0
        self.life = 1
        self.doubled = 0  # scans in a row on the same subset as the other one

    def put(self, position_px: float, deviation_px: float, most: int, *, seen: bool) -> None:
        self.position_px.append(position_px)
        self.deviation_px.append(deviation_px)
        del self.position_px[:-most], self.deviation_px[:-most]
        self.missed = 0 if seen else self.missed + 1
        if seen:
            self.seen_px = position_px
            self.life += 1


class WindowSensorTracker:
    """Up to two targets: ``PairTracker``, and how targets come and go.

    The text has two targets that are there from the first scan to the last. Here:

    - Tracks begin in a scan with no more points than ``targets``. While one runs alone it takes
      the point nearest to what the window predicts; a single further point begins the other.
    - Points that no target can have reached, by ``max_velocity_px_s`` since its last one, are not
      looked at.
    - A track that is without a point for more than ``coast_scans`` ends. One that has gone over to
      the other's subset, while the other has not, follows the same target: after ``young_scans``
      such scans the younger one ends, and the free point begins a new one.

    Args:
        settings: of the method.
        targets: how many are followed, 1 or 2.
    """

    def __init__(self, settings: ThesisSettings, targets: int) -> None:
        self._settings = settings
        self._targets = targets
        self._window = QuadraticWindow(settings.window_points)
        self._max_points = max(self._window.points, 2)
        self._running: list[_Target] = []
        self._pair: tuple[PairTracker, SubsetOrder] | None = None
        self._begun = 0

    def step(
        self, position_px: Array, deviation_px: Array, interval_s: float
    ) -> Sequence[SensorPoint]:
        """Return where each running track is after the next scan; see SensorTracker."""
        taken: dict[int, int] = {}
        within = np.array([self._reached(float(x), interval_s) for x in position_px], dtype=bool)
        if self._pair is not None:
            near = np.where(within, position_px, np.nan)
            taken = self._step_pair(self._pair, near, deviation_px, interval_s)
        elif self._running:
            taken = self._step_single(np.where(within, position_px, np.nan), deviation_px)
        shared = len(set(taken.values())) < len(taken)
        self._end()
        free = np.flatnonzero(~np.isnan(position_px))
        free = free[~np.isin(free, list(taken.values()))]
        taken |= self._begin(free, position_px, deviation_px)
        return [
            SensorPoint(
                one.number,
                one.position_px[-1],
                taken.get(one.number, -1),
                one.life,
                0.0 if one.number in taken else one.deviation_px[-1],
                shared and one.number in taken,
            )
            for one in self._running
        ]

    def _reached(self, position_px: float, interval_s: float) -> bool:
        most = self._settings.max_velocity_px_s * interval_s
        return any(
            abs(position_px - one.seen_px) <= most * (1 + one.missed) for one in self._running
        )

    def _step_single(self, near_px: Array, deviation_px: Array) -> dict[int, int]:
        (one,) = self._running
        expected = self._window.next_position(one.position_px)
        if np.isnan(near_px).all():
            one.put(
                expected,
                self._window.next_deviation(one.deviation_px),
                self._max_points,
                seen=False,
            )
            return {}
        point = int(np.nanargmin(np.abs(near_px - expected)))
        one.put(float(near_px[point]), float(deviation_px[point]), self._max_points, seen=True)
        return {one.number: point}

    def _step_pair(
        self,
        pair: tuple[PairTracker, SubsetOrder],
        near_px: Array,
        deviation_px: Array,
        interval_s: float,
    ) -> dict[int, int]:
        follower, order = pair
        points = order.step(near_px)
        subsets = np.array([near_px[point] if point >= 0 else np.nan for point in points])
        found = follower.step(subsets, interval_s)
        taken: dict[int, int] = {}
        doubled, both = found[0].subset == found[1].subset, min(points) >= 0
        for one, now in zip(self._running, found, strict=True):
            one.doubled = one.doubled + both if doubled else 0
            if now.created:
                made = self._window.next_deviation(one.deviation_px)
                one.put(now.position_px, made, self._max_points, seen=False)
                continue
            point = points[now.subset]
            taken[one.number] = point
            one.put(now.position_px, float(deviation_px[point]), self._max_points, seen=True)
        return taken

    def _end(self) -> None:
        """End tracks that are not seen any more, or that follow another one's target."""
        given = self._settings
        before = len(self._running)
        self._running = [one for one in self._running if one.missed <= given.coast_scans]
        if len(self._running) == 2 and self._running[0].doubled > given.young_scans:
            self._running.sort(key=lambda one: one.number)
            self._running.pop()
        if len(self._running) < before:
            self._pair = None
            for one in self._running:
                one.doubled = 0

    def _begin(
        self, free: NDArray[np.intp], position_px: Array, deviation_px: Array
    ) -> dict[int, int]:
        """Begin tracks of points that are free, if there is no choice between them."""
        if not 0 < len(free) <= self._targets - len(self._running):
            return {}
        taken = {}
        for point in free[np.argsort(position_px[free], kind="stable")].tolist():
            taken[self._begun] = point
            begun = _Target(self._begun, float(position_px[point]), float(deviation_px[point]))
            self._running.append(begun)
            self._begun += 1
        if len(self._running) == 2:
            self._running.sort(key=lambda one: one.position_px[-1])
            self._pair = self._create_pair_tracker()
        return taken

    def _create_pair_tracker(self) -> tuple[PairTracker, SubsetOrder]:
        left, right = self._running
        first = np.array([left.position_px[-1], right.position_px[-1]])
        follower = PairTracker(
            first,
            self._settings.limit_px_s,
            self._window,
            self._settings.window_decision,
            (left.position_px[:-1], right.position_px[:-1]),
        )
        return follower, SubsetOrder(last_px=first)
