"""Fusion of tracks along the sensors to markers in space."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurements import Measurements
from compute.tracking.track_batch import TrackFlag
from validation.thesis_tracking.fused_marker import (
    FusedMarker,
    deviation_of,
    nearest_marker,
    predicted_positions,
    track_readings,
)
from validation.thesis_tracking.point_reconstruction import SolvedPoints, SpacePoints
from validation.thesis_tracking.scan_clock import ScanClock
from validation.thesis_tracking.sensor_point import SensorPoint, SensorTracker
from validation.thesis_tracking.settings import MIN_SENSORS, ThesisSettings
from validation.thesis_tracking.slot_tracker import (
    AMBIGUOUS_CONFIRMATION_EXPOSURES,
    MIN_AGREEING_SENSORS,
    SlotTracker,
    packed_columns,
)
from validation.thesis_tracking.track_report import TrackReport

Array = NDArray[np.float64]
Running = list[dict[int, SensorPoint]]


class SensorTrackFusion(SlotTracker):
    """1D tracking and identification, then 3D reconstruction and verification: section 6.3.

    For each exposure: every sensor's follower associates its points with its tracks; markers are
    reconstructed from the readings of the tracks that are theirs; who a marker is, its tracks say.
    Which tracks are one marker's is found when they are not young any more, by the grouping of
    their readings (``group_peaks``; for two markers and more it needs four sensors), and again
    when one of them ended: by the marker's prediction along that sensor, or by a new group where
    the marker should be. A marker of a group that is ambiguous is tentative, until its sensors have
    agreed in ``AMBIGUOUS_CONFIRMATION_EXPOSURES``; it ends when they contradict one another.

    Points that a follower made up are used only where fewer than three sensors saw the marker. A
    sensor whose reading was left out for ``young_scans`` exposures is let go. Where the sensors
    contradict one another and nobody knows which is wrong there is no point, the marker is
    predicted, and ambiguous; after as many exposures all its tracks are let go.

    Args:
        settings: of the method.
        space: reconstruction.
        marker: strobe slot; -1: all are lit.
        next_identity: gives a number that nobody has had.
        sensor_tracker: makes a sensor's follower.
    """

    def __init__(
        self,
        settings: ThesisSettings,
        space: SpacePoints,
        marker: int,
        next_identity: Callable[[], int],
        sensor_tracker: Callable[[], SensorTracker],
    ) -> None:
        super().__init__(settings, space, marker, next_identity)
        self._clock = ScanClock()
        self._sensor_trackers = [sensor_tracker() for _ in range(len(space.model))]
        self._markers: list[FusedMarker] = []

    @property
    def alive(self) -> bool:
        """Whether a marker is followed."""
        return bool(self._markers)

    def step(self, time_ns: int, peaks: Measurements) -> list[TrackReport]:
        """Return the lane's markers after one exposure."""
        scans = self._clock.step(time_ns)
        position = peaks.position_px
        deviation = np.sqrt(peaks.variance_px2)
        for _ in range(min(scans - 1, self.settings.coast_scans + 1)):
            # An exposure that was lost on the way is a scan without points.
            for sensor_tracker, sigma in zip(self._sensor_trackers, deviation, strict=True):
                sensor_tracker.step(np.full(len(sigma), np.nan), sigma, self._clock.interval_s)
        current_points: Running = [
            {one.number: one for one in sensor_tracker.step(row, sigma, self._clock.interval_s)}
            for sensor_tracker, row, sigma in zip(
                self._sensor_trackers, position, deviation, strict=True
            )
        ]
        for marker in self._markers:
            marker.keep_running(current_points)
        found, points = self._located(current_points, deviation, time_ns)
        self._bind_ended(current_points, deviation, time_ns, found)
        self._group(current_points, deviation, time_ns, found)
        limit_ns = 1e9 * self.settings.coast_s
        self._markers = [
            one
            for one in self._markers
            if time_ns - one.seen_ns <= limit_ns
            and not (one.exposures_to_confirm and one.contradicted.any())
        ]
        return self._reports(time_ns, points, found)

    def predicted(self, time_ns: int) -> list[TrackReport]:
        """Return the lane's markers at a time when they are dark."""
        return self._reports(time_ns, {}, {})

    def _located(
        self, current_points: Running, deviation: Array, time_ns: int
    ) -> tuple[dict[int, SolvedPoints], dict[int, list[SensorPoint | None]]]:
        """Reconstruct the markers; return their points, one each, and their tracks' points."""
        if not self._markers:
            return {}, {}
        points = {one.identity: one.points(current_points) for one in self._markers}
        rows = [track_readings(points[one.identity], deviation) for one in self._markers]
        readings, sigma = (np.stack(part) for part in zip(*rows, strict=True))
        position, covariance = predicted_positions(self._markers, time_ns)
        young = np.array([not one.kinematics.is_complete for one in self._markers])
        position[young] = np.nan
        solved = self.space.solve(readings, sigma, position, covariance)
        found: dict[int, SolvedPoints] = {}
        for row, marker in enumerate(self._markers):
            if self._verified(marker, solved, row):
                self._take(marker, solved, row, points[marker.identity], time_ns)
                found[marker.identity] = solved.row(row)
        return found, points

    def _verified(self, marker: FusedMarker, solved: SolvedPoints, row: int) -> bool:
        """Let go of tracks that are another target's; return whether there is a point."""
        if not solved.found[row]:
            return False
        if marker.exposures_to_confirm and solved.inconsistent[row]:
            marker.contradicted[:] = 1
            return False
        left = np.arange(len(marker.tracks)) == solved.left_out[row]
        marker.contradicted = np.where(left, marker.contradicted + 1, 0)
        marker.unbind(marker.contradicted >= self.settings.young_scans)
        marker.inconsistent = marker.inconsistent + 1 if solved.inconsistent[row] else 0
        if marker.inconsistent >= self.settings.young_scans:
            marker.unbind(np.ones(len(left), dtype=bool))
            marker.inconsistent = 0
        return not solved.inconsistent[row]

    def _take(
        self,
        marker: FusedMarker,
        solved: SolvedPoints,
        row: int,
        points: list[SensorPoint | None],
        time_ns: int,
    ) -> None:
        """Take a marker's new point, if anything was seen of it."""
        seen = [
            one is not None and one.peak >= 0 and sensor != solved.left_out[row]
            for sensor, one in enumerate(points)
        ]
        if any(seen):
            marker.kinematics.add(time_ns, solved.position_mm[row], solved.covariance_mm2[row])
        if sum(seen) >= MIN_SENSORS:
            marker.seen_ns = time_ns
        if sum(seen) >= MIN_AGREEING_SENSORS:
            marker.exposures_to_confirm = max(marker.exposures_to_confirm - 1, 0)

    def _free(self, current_points: Running) -> list[list[SensorPoint]]:
        """Return each sensor's tracks that are no marker's, are seen, and not young any more."""
        owned = [
            {int(one.tracks[sensor]) for one in self._markers}
            for sensor in range(len(current_points))
        ]
        return [
            [
                one
                for one in points.values()
                if one.number not in taken
                and one.peak >= 0
                and not one.shared
                and one.life >= self.settings.young_scans
            ]
            for points, taken in zip(current_points, owned, strict=True)
        ]

    def _bind_ended(
        self,
        current_points: Running,
        deviation: Array,
        time_ns: int,
        found: dict[int, SolvedPoints],
    ) -> None:
        """Give markers that lack a sensor's track the free one where they are along it.

        Not where another marker is as near: a group, or the time, must tell them apart.
        """
        is_complete = [
            one for one in self._markers if one.kinematics.is_complete and one.identity in found
        ]
        free = self._free(current_points)
        lacking = np.array([one.tracks < 0 for one in is_complete]).reshape(-1, len(current_points))
        if not lacking.any():
            return
        position, covariance = predicted_positions(is_complete, time_ns)
        for sensor, points in enumerate(free):
            rows = np.flatnonzero(lacking[:, sensor])
            if not len(rows) or not points:
                continue
            readings = np.array([[one.position_px] for one in points])
            sigma = np.array([[deviation_of(one, deviation[sensor])] for one in points])
            off = np.stack([
                np.abs(self.space.innovation(
                    readings, sigma,
                    np.broadcast_to(position[row], (len(points), 3)),
                    np.broadcast_to(covariance[row], (len(points), 3, 3)),
                )[:, sensor])
                for row in range(len(is_complete))
            ])  # fmt: skip
            near = off <= self.settings.gate_sigma
            for row in rows.tolist():
                own = np.flatnonzero(near[row])
                if len(own) == 1 and near[:, own[0]].sum() == 1:
                    is_complete[row].tracks[sensor] = points[int(own[0])].number

    def _group(
        self,
        current_points: Running,
        deviation: Array,
        time_ns: int,
        found: dict[int, SolvedPoints],
    ) -> None:
        """Group tracks that are no marker's: markers that were lost, or new ones."""
        free = self._free(current_points)
        if sum(map(bool, free)) < MIN_SENSORS or not self._may_group(time_ns):
            return
        readings = packed_columns([[one.position_px for one in points] for points in free])
        sigma = packed_columns(
            [
                [deviation_of(one, deviation[sensor]) for one in points]
                for sensor, points in enumerate(free)
            ]
        )
        groups = self.space.group(readings, sigma)
        if not len(groups):
            return
        nowhere = np.full((len(groups), 3), np.nan)
        blank = np.zeros((len(groups), 3, 3))
        solved = self.space.solve(groups.readings_px, groups.sigma_px, nowhere, blank)
        for row in self._groups_to_take(groups, solved):
            numbers = np.array(
                [
                    points[column].number if column >= 0 else -1
                    for points, column in zip(free, groups.peaks[row].tolist(), strict=True)
                ]
            )
            position, spread = solved.position_mm[row], solved.covariance_mm2[row]
            lost = [one for one in self._markers if one.identity not in found]
            marker = nearest_marker(lost, position, spread, time_ns)
            if marker is None:
                if not self._may_begin(len(self._markers)):
                    continue
                exposures_to_confirm = (
                    AMBIGUOUS_CONFIRMATION_EXPOSURES if groups.ambiguous[row] else 0
                )
                marker = FusedMarker(
                    self.next_identity(), numbers, self.settings, time_ns, exposures_to_confirm
                )
                self._markers.append(marker)
            marker.tracks, marker.seen_ns = numbers, time_ns
            marker.kinematics.add(time_ns, position, spread)
            found[marker.identity] = solved.row(row)

    def _reports(
        self,
        time_ns: int,
        points: dict[int, list[SensorPoint | None]],
        found: dict[int, SolvedPoints],
    ) -> list[TrackReport]:
        reports = []
        for one in self._markers:
            if not one.kinematics.is_complete:
                continue
            mean, covariance = one.kinematics.at(time_ns)
            taken = np.full(len(one.tracks), -1, dtype=np.int32)
            flags = TrackFlag.NONE
            solved = found.get(one.identity)
            for sensor, point in enumerate(points.get(one.identity, ())):
                if point is None or point.peak < 0 or solved is None:
                    continue
                if sensor == solved.left_out[0]:
                    continue
                taken[sensor] = point.peak
                flags |= TrackFlag.MERGED if point.shared else TrackFlag.NONE
            if one.inconsistent:
                flags |= TrackFlag.AMBIGUOUS
            if solved is not None and solved.outside_map[0]:
                flags |= TrackFlag.OUTSIDE_MAP
            reports.append(
                TrackReport(
                    one.identity,
                    self.marker,
                    one.exposures_to_confirm > 0,
                    mean,
                    covariance,
                    taken,
                    flags,
                    dof=int((taken >= 0).sum()),
                )
            )
        return reports
