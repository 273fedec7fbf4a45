"""Tracker of markers in space by the 8-state model [6.11]."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from compute.measurement.measurements import Measurements
from compute.reconstruction.triangulation import chi2_limit
from compute.tracking.track_batch import TrackFlag
from validation.thesis_tracking.eight_state import EightState, EightStateModel
from validation.thesis_tracking.finite_difference_kinematics import (
    START_ACCELERATION_MM_S2,
    START_SPEED_MM_S,
)
from validation.thesis_tracking.point_reconstruction import SolvedPoints, SpacePoints
from validation.thesis_tracking.settings import MIN_SENSORS, ThesisSettings
from validation.thesis_tracking.slot_tracker import (
    AMBIGUOUS_CONFIRMATION_EXPOSURES,
    MIN_AGREEING_SENSORS,
    SlotTracker,
    packed_columns,
)
from validation.thesis_tracking.track_report import TrackReport

Array = NDArray[np.float64]

GATE_EXCLUSION_PROBABILITY: Final = 1e-5
"""Chance that a marker's own point lies outside its gate."""
SEARCH_PX: Final = 10.0
"""A marker that is predicted less well along a sensor takes no single readings there."""
_NEVER: Final = 1e9


@dataclass(eq=False)
class _Marker:
    identity: int
    state: EightState
    time_ns: int
    seen_ns: int
    hits: int = 1
    missed: int = 0
    exposures_to_confirm: int = 0
    """Exposures in which four sensors must agree before it counts."""


@dataclass(frozen=True, eq=False)
class _Seen:
    """What a marker took in this exposure."""

    peaks: NDArray[np.int32]
    nis: float
    flags: TrackFlag


class PointTracker(SlotTracker):
    """Tracking and identification in space, where section 6.3 expects less ambiguity than in 1D.

    For each exposure: [6.11] predicts each marker; along each sensor the readings nearest to the
    predictions, by their deviations, go to the markers, each to one; the readings of three
    sensors or more are a point, verified as ``SpacePoints.solve`` has it; the point updates the
    8-state filter, if it lies where the marker can be. Readings that are left over are grouped to
    points: of markers that were lost, where they should be now, or of new ones. A new one that is
    missed at once has a "short life", and ends; so does one of an ambiguous group, until four
    sensors have agreed on it in ``AMBIGUOUS_CONFIRMATION_EXPOSURES``.

    Args:
        as of ``SlotTracker``.
    """

    def __init__(
        self,
        settings: ThesisSettings,
        space: SpacePoints,
        marker: int,
        next_identity: Callable[[], int],
    ) -> None:
        super().__init__(settings, space, marker, next_identity)
        self._model = EightStateModel(settings.acceleration_psd, settings.jerk_psd)
        self._markers: list[_Marker] = []

    @property
    def alive(self) -> bool:
        """Whether a marker is followed."""
        return bool(self._markers)

    def step(self, time_ns: int, peaks: Measurements) -> list[TrackReport]:
        """Return the lane's markers after one exposure."""
        for one in self._markers:
            one.state, one.time_ns = self._at(one, time_ns), time_ns
        position = peaks.position_px
        sigma = np.sqrt(peaks.variance_px2)
        chosen = self._chosen(position, sigma)
        seen = self._updated(chosen, position, sigma, time_ns)
        free = peaks.usable & peaks.can_initiate
        for taken in seen.values():
            sensor = np.flatnonzero(taken.peaks >= 0)
            free[sensor, taken.peaks[sensor]] = False
        self._group(free, position, sigma, time_ns, seen)
        self._end(time_ns, seen)
        return [self._report(one, one.state, seen.get(one.identity)) for one in self._markers]

    def predicted(self, time_ns: int) -> list[TrackReport]:
        """Return the lane's markers at a time when they are dark."""
        return [self._report(one, self._at(one, time_ns), None) for one in self._markers]

    def _at(self, one: _Marker, time_ns: int) -> EightState:
        if time_ns <= one.time_ns:
            return one.state
        return one.state.predicted(self._model, (time_ns - one.time_ns) * 1e-9)

    def _chosen(self, position: Array, sigma: Array) -> NDArray[np.intp]:
        """Return the peak that each marker takes of each sensor, -1: none, (M, S)."""
        chosen = np.full((len(self._markers), len(position)), -1, dtype=np.intp)
        if not self._markers or not position.size:
            return chosen
        place = np.stack([one.state.position_mm for one in self._markers])
        spread = np.stack([one.state.covariance[:3, :3] for one in self._markers])
        predicted = self.space.model.predict(place)
        variance = np.einsum(
            "nsi,nij,nsj->ns", predicted.jacobian_px_per_mm, spread, predicted.jacobian_px_per_mm
        )
        variance += np.diagonal(self.space.model.systematic_covariance(place), axis1=1, axis2=2)
        lost = np.array([one.missed > 0 for one in self._markers])
        for sensor, row in enumerate(position):
            off = row[None] - predicted.reading_px[:, sensor, None]
            total = variance[:, sensor, None] + sigma[sensor][None] ** 2
            cost = off**2 / total + np.log(total)
            bad = ~(off**2 <= self.settings.gate_sigma**2 * total)
            bad |= (lost & (variance[:, sensor] > SEARCH_PX**2))[:, None]
            rows, columns = linear_sum_assignment(np.where(bad, _NEVER, cost))
            good = ~bad[rows, columns]
            chosen[rows[good], sensor] = columns[good]
        return chosen

    def _updated(
        self, chosen: NDArray[np.intp], position: Array, sigma: Array, time_ns: int
    ) -> dict[int, _Seen]:
        """Update the markers by the points of their readings; return what they saw."""
        if not self._markers:
            return {}
        sensors = np.arange(len(position))
        place = np.stack([one.state.position_mm for one in self._markers])
        spread = np.stack([one.state.covariance[:3, :3] for one in self._markers])
        if position.size:
            readings = np.where(chosen >= 0, position[sensors, chosen], np.nan)
            deviation = sigma[sensors, chosen]
        else:
            readings = deviation = np.full(chosen.shape, np.nan)
        solved = self.space.solve(readings, deviation, place, spread)
        seen = {}
        for row in np.flatnonzero(solved.found & ~solved.inconsistent).tolist():
            one = self._markers[row]
            if one.exposures_to_confirm and solved.left_out[row] >= 0:
                continue
            after, nis = one.state.updated(solved.position_mm[row], solved.covariance_mm2[row])
            if nis > chi2_limit(3, GATE_EXCLUSION_PROBABILITY):
                continue
            one.state, one.seen_ns = after, time_ns
            one.hits, one.missed = one.hits + 1, 0
            taken = np.where(sensors == solved.left_out[row], -1, chosen[row])
            seen[one.identity] = _Seen(taken.astype(np.int32), nis, _flags(solved, row))
            if (taken >= 0).sum() >= MIN_AGREEING_SENSORS:
                one.exposures_to_confirm = max(one.exposures_to_confirm - 1, 0)
        return seen

    def _group(
        self,
        free: NDArray[np.bool_],
        position: Array,
        sigma: Array,
        time_ns: int,
        seen: dict[int, _Seen],
    ) -> None:
        """Group readings that are no marker's: markers that were lost, or new ones."""
        columns = [np.flatnonzero(row).tolist() for row in free]
        if sum(map(bool, columns)) < MIN_SENSORS or not self._may_group(time_ns):
            return
        groups = self.space.group(
            *(
                packed_columns([row[own].tolist() for row, own in zip(table, columns, strict=True)])
                for table in (position, sigma)
            )
        )
        if not len(groups):
            return
        nowhere, blank = np.full((len(groups), 3), np.nan), np.zeros((len(groups), 3, 3))
        solved = self.space.solve(groups.readings_px, groups.sigma_px, nowhere, blank)
        for row in self._groups_to_take(groups, solved):
            place, spread = solved.position_mm[row], solved.covariance_mm2[row]
            one, nis = self._nearest(place, spread, seen), float("nan")
            if one is None:
                if not self._may_begin(len(self._markers)):
                    continue
                state = EightState.at(place, spread, START_SPEED_MM_S, START_ACCELERATION_MM_S2)
                exposures_to_confirm = (
                    AMBIGUOUS_CONFIRMATION_EXPOSURES if groups.ambiguous[row] else 0
                )
                one = _Marker(
                    self.next_identity(),
                    state,
                    time_ns,
                    time_ns,
                    exposures_to_confirm=exposures_to_confirm,
                )
                self._markers.append(one)
            else:
                one.state, nis = one.state.updated(place, spread)
                one.seen_ns, one.hits, one.missed = time_ns, one.hits + 1, 0
            taken = [
                own[column] if column >= 0 else -1
                for own, column in zip(columns, groups.peaks[row].tolist(), strict=True)
            ]
            seen[one.identity] = _Seen(np.array(taken, np.int32), nis, _flags(solved, row))

    def _nearest(
        self, position_mm: Array, covariance_mm2: Array, seen: dict[int, _Seen]
    ) -> _Marker | None:
        """Return the lost marker that a point is nearest to, within its gate."""
        best, least = None, chi2_limit(3, GATE_EXCLUSION_PROBABILITY)
        for one in self._markers:
            if one.identity not in seen:
                nis = one.state.updated(position_mm, covariance_mm2)[1]
                if nis <= least:
                    best, least = one, nis
        return best

    def _end(self, time_ns: int, seen: dict[int, _Seen]) -> None:
        kept = []
        for one in self._markers:
            one.missed = 0 if one.identity in seen else one.missed + 1
            young = self._young(one)
            late = time_ns - one.seen_ns > 1e9 * self.settings.coast_s
            if not late and not (young and one.missed):
                kept.append(one)
        self._markers = kept

    def _young(self, one: _Marker) -> bool:
        return one.hits < self.settings.young_scans or one.exposures_to_confirm > 0

    def _report(self, one: _Marker, state: EightState, seen: _Seen | None) -> TrackReport:
        mean = np.append(state.mean, 0.0)
        covariance = np.full((9, 9), np.nan)
        covariance[:8, :8] = state.covariance
        sensors = len(self.space.model)
        nothing = np.full(sensors, -1, dtype=np.int32)
        measured = seen is not None and np.isfinite(seen.nis)
        return TrackReport(
            one.identity,
            self.marker,
            self._young(one),
            mean,
            covariance,
            nothing if seen is None else seen.peaks,
            TrackFlag.NONE if seen is None else seen.flags,
            seen.nis if seen is not None else float("nan"),
            3 if measured else 0,
        )


def _flags(solved: SolvedPoints, row: int) -> TrackFlag:
    return TrackFlag.OUTSIDE_MAP if solved.outside_map[row] else TrackFlag.NONE
