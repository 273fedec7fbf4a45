"""TrackInitiator: new and recovered tracks from unassociated peaks."""

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import PredictedMeasurements
from compute.reconstruction.correspondence.predicted_candidates import PredictedPoints
from compute.tracking.candidate_tracks import CandidateBatch
from compute.tracking.motion_model import ImmStates, combine_modes, is_finite, mean_positions
from compute.tracking.multi_scan_initiation import MultiScanInitiator
from compute.tracking.native.kernels import Associator
from compute.tracking.state_initialisation import states_from_points
from compute.tracking.track_management import (
    MIN_SUPPORTED_HITS_AMBIGUOUS,
    PROBATION_EXPOSURES,
    expired,
    find_replaced_track,
    match_lost_track,
    possibly_swapped,
    select_confirmed,
)
from compute.tracking.tracks import MIN_SUPPORT_SENSORS, Associations, Exposure, Tracks
from compute.tracking.unassociated_points import (
    UnassociatedPointFinder,
    UnassociatedPoints,
    assign_points,
    update_with_points,
)

Array = NDArray[np.float64]


class TrackInitiator:
    """Initiates, confirms, recovers and deletes tracks; assigns their identity numbers.

    A track whose state is no longer finite ends: its marker is found anew.

    A tentative track lives on peaks that confirmed tracks leave: a ghost of theirs has none. It
    begins with two points of at least three sensors; then it is followed as others are.

    Args:
        finder: of points.
        associator: of peaks with tracks.
    """

    def __init__(self, finder: UnassociatedPointFinder, associator: Associator) -> None:
        self._motion, self._settings = associator.motion, associator.settings
        self._next = 1
        self._searched_ns: dict[int | None, int] = {}
        self.set_cameras(finder, associator)

    def set_cameras(self, finder: UnassociatedPointFinder, associator: Associator) -> None:
        """Switch to another calibration of the same sensors.

        Args:
            finder: reconstructs points from unassociated peaks by it.
            associator: associates peaks with tracks by it.
        """
        self._finder, self._associator, self._model = finder, associator, associator.model
        self._dense_scene = MultiScanInitiator(finder, associator)

    def reset(self) -> None:
        """Reset the search; identity numbers continue."""
        self._searched_ns.clear()
        self._dense_scene.forget()

    def numbers(self, count: int) -> int:
        """Reserve consecutive identity numbers and return the first."""
        first = self._next
        self._next += count
        return first

    def find(
        self,
        tracks: Tracks,
        part: NDArray[np.intp],
        associations: Associations,
        exposure: Exposure,
        unassociated: NDArray[np.bool_],
    ) -> tuple[Tracks, Associations]:
        """Search the free peaks; return the tracks and their associations after it.

        Args:
            tracks: all; those that take part are changed.
            part: rows of those that the exposure may show.
            associations: their peaks in this exposure so far.
            exposure: the exposure.
            unassociated: its peaks that no track has seen so far, shape (S, K).
        """
        marker, time_ns, peaks = exposure.marker, exposure.time_ns, exposure.peaks
        last = self._searched_ns.get(marker)
        due = last is None or time_ns - last >= round(self._settings.initiation_interval_s * 1e9)
        due |= marker is not None and not (tracks.marker == marker).any()
        if not due and self._nothing_to_do(tracks, unassociated, exposure):
            return tracks, associations
        hits = tracks.hits[part].copy()
        tentative = part[~tracks.confirmed[part]]
        self._update_tentative(
            tracks, tentative[tracks.hits[tentative] > 0], associations, exposure
        )
        sound = is_finite(tracks.states)
        hits, part = hits[sound[part]], part[sound[part]]
        tentative = tentative[sound[tentative]]
        begun = tentative[tracks.hits[tentative] == 0]
        new: tuple[Tracks, Associations] | None = None
        # What a weak track has may be another marker's; it may find it again itself.
        unsupported = self._possible_ghosts(tracks, part, associations)
        free = associations.free_peaks(peaks, unsupported)
        ghost_suspected = bool(unsupported.any())
        if marker is None and self._dense_scene.is_dense(free, ghost_suspected=ghost_suspected):
            confirmed = self._dense_scene.search(time_ns, peaks, free)
            new = None if confirmed is None else self._start_confirmed(confirmed, exposure)
        elif due or len(begun):
            self._searched_ns[marker] = time_ns
            lost = tracks.confirmed & (associations.sensor_counts() < 3)
            open_ = np.union1d(begun, part[unsupported[part] | lost[part]])
            points = self._finder.find(peaks, free, self._expected(tracks, open_))
            if points is not None:
                others = self._match(tracks, open_, points, associations, exposure)
                if len(others):
                    new = self._start_tentative(points.rows(others), exposure)
        tracks.misses[part] += ~tracks.confirmed[part] & (tracks.hits[part] == hits)
        if new is not None:
            tracks = Tracks.concatenate([tracks, new[0]])
            associations = Associations.concatenate([associations, new[1]])
        keep = self._confirm(tracks, part, associations, unsupported, time_ns)
        keep &= ~expired(tracks, self._settings, time_ns)
        # What is not finite now never will be again, and has no position.
        keep[: len(sound)] &= sound
        return (
            (tracks, associations) if keep.all() else (tracks.rows(keep), associations.rows(keep))
        )

    def _nothing_to_do(
        self, tracks: Tracks, unassociated: NDArray[np.bool_], exposure: Exposure
    ) -> bool:
        """Return whether nothing is to be done where no search is due: the short way out."""
        if not tracks.confirmed.all() or tracks.may_be_ghosts.any():
            return False
        coast_ns = round(self._settings.coast_s * 1e9)
        if len(tracks) and exposure.time_ns - int(tracks.last_detection_ns.min()) > coast_ns:
            return False
        states = tracks.states
        # One that is not finite makes the sum so.
        total = states.mean.sum() + states.covariance.sum() + states.probability.sum()
        if not np.isfinite(total):
            return False
        return exposure.marker is not None or not self._dense_scene.is_dense(
            unassociated, ghost_suspected=False
        )

    def _possible_ghosts(
        self, tracks: Tracks, part: NDArray[np.intp], associations: Associations
    ) -> NDArray[np.bool_]:
        """Return which tracks may be ghosts, or have peaks of those that may be, shape (T,)."""
        unsupported = tracks.confirmed & tracks.may_be_ghosts
        unsupported &= associations.sensor_counts() >= 2
        if not unsupported[part].any():
            return unsupported
        reading = self._model.predict(mean_positions(tracks.states)).reading_px
        return possibly_swapped(
            reading, unsupported, tracks.confirmed, self._settings.resolution_px
        )

    def _update_tentative(
        self, tracks: Tracks, rows: NDArray[np.intp], associations: Associations, exposure: Exposure
    ) -> None:
        """Update tentative tracks, of which the velocity is known, by peaks that are left."""
        if len(rows) == 0:
            return
        unassociated = exposure.peaks.only(associations.free_peaks(exposure.peaks))
        association = self._associator.associate(
            tracks.states.rows(rows), tracks.bias[rows], unassociated
        )
        tracks.states.put(rows, association.states)
        associations.peaks[rows], associations.nis[rows] = association.peaks, association.nis
        associations.merged[rows] = association.merged.any(axis=1)
        sensor_counts = (association.peaks >= 0).sum(axis=1)
        hit = sensor_counts >= 3
        predicted = self._model.predict(mean_positions(association.states))
        tracks.supported_hits[rows] += hit & self._supported(predicted, association.peaks, exposure)
        tracks.hits[rows] += hit
        tracks.log_likelihood_ratio[rows] += association.log_likelihood_ratio
        missed = np.maximum(association.in_view - sensor_counts, 0)
        tracks.log_likelihood_ratio[rows] += missed * np.log(
            1.0 - self._settings.detection_probability
        )
        tracks.last_detection_ns[rows[hit]] = exposure.time_ns

    def _expected(self, tracks: Tracks, rows: NDArray[np.intp]) -> PredictedPoints:
        combined = combine_modes(self._motion, tracks.states.rows(rows))
        return PredictedPoints(combined.mean[:, :3], combined.covariance[:, :3, :3])

    def _match(
        self,
        tracks: Tracks,
        open_: NDArray[np.intp],
        points: UnassociatedPoints,
        associations: Associations,
        exposure: Exposure,
    ) -> NDArray[np.intp]:
        """Update open tracks by their points; return the points that start others."""
        rows, columns = assign_points(self._motion, tracks.states.rows(open_), points)
        rows, marker = open_[rows], exposure.marker
        if len(rows):
            self._update(tracks, rows, points.rows(columns), associations, exposure)
            if marker is not None:
                tracks.marker[rows] = marker
        if marker is not None:
            same_marker = tracks.confirmed & (tracks.marker == marker)
            if (same_marker & (associations.sensor_counts() >= 3)).any():
                return np.empty(0, dtype=np.intp)
        return np.setdiff1d(np.arange(len(points)), columns)

    def _update(
        self,
        tracks: Tracks,
        rows: NDArray[np.intp],
        points: UnassociatedPoints,
        associations: Associations,
        exposure: Exposure,
    ) -> None:
        """Update tracks by the readings of their points, one each."""
        peaks, sensor, chosen = exposure.peaks, np.arange(len(self._model)), points.peaks
        at = np.maximum(chosen, 0)
        # A sensor whose peak the track has already says nothing new.
        fresh = (chosen >= 0) & (associations.peaks[rows] < 0)
        update = update_with_points(
            self._model,
            self._settings,
            tracks.states.rows(rows),
            tracks.bias[rows],
            np.where(fresh, peaks.position_px[sensor, at], np.nan),
            peaks.variance_px2[sensor, at],
            points.position_mm,
        )
        tracks.states.put(rows, update.states)
        associations.peaks[rows] = np.where(fresh, chosen, associations.peaks[rows])
        associations.nis[rows] += update.nis
        tracks.hits[rows] += 1
        tracks.supported_hits[rows] += self._supported(update.predicted, chosen, exposure)
        tracks.log_likelihood_ratio[rows] += update.log_likelihood_ratio
        tracks.last_detection_ns[rows] = exposure.time_ns
        now, before = points.ambiguous & fresh.any(axis=1), tracks.ambiguous_identity[rows]
        tracks.ambiguous_identity[rows] = np.where(
            tracks.confirmed[rows], before | now, before & now
        )

    def _supported(
        self,
        predicted: PredictedMeasurements,
        chosen: NDArray[np.int32],
        exposure: Exposure,
    ) -> NDArray[np.bool_]:
        """Return whether these points are no ghosts by what sensors see of them, shape (N,).

        A peak that another track has says so, too, where it may be shared.
        """
        peaks = exposure.peaks
        if exposure.marker is not None or int(peaks.usable.sum(axis=1).max()) == 1:
            # A marker that is lit alone, or alone in view, has no ghosts.
            return np.ones(len(chosen), dtype=np.bool_)
        shared = peaks.is_near(predicted.reading_px, self._settings.resolution_px)
        count = ((chosen >= 0) | shared).sum(axis=1)
        few = predicted.in_view.sum(axis=1) < MIN_SUPPORT_SENSORS
        supported: NDArray[np.bool_] = (count >= MIN_SUPPORT_SENSORS) | few
        return supported

    def _start_tentative(
        self, points: UnassociatedPoints, exposure: Exposure
    ) -> tuple[Tracks, Associations]:
        """Return tentative tracks at these points, and their associations."""
        position_mm = points.position_mm
        states, bias = states_from_points(
            self._model, self._motion, self._settings, position_mm, points.sigma_px
        )
        associations = Associations.missed(len(points), len(self._model))
        associations.peaks[:] = points.peaks
        return self._start(states, bias, position_mm, points.ambiguous, exposure), associations

    def _start_confirmed(
        self, candidates: CandidateBatch, exposure: Exposure
    ) -> tuple[Tracks, Associations]:
        """Return the tracks of markers that have been followed for long enough."""
        associations = Associations.missed(len(candidates), len(self._model))
        associations.peaks[:], associations.nis[:] = candidates.peaks[:, -1], candidates.nis
        tracks = self._start(
            candidates.states,
            candidates.bias,
            candidates.position_mm,
            candidates.ambiguous,
            exposure,
        )
        tracks.hits[:] = self._settings.confirm_hits
        tracks.supported_hits[:] = MIN_SUPPORTED_HITS_AMBIGUOUS
        tracks.log_likelihood_ratio[:] = np.inf
        tracks.remaining_probation[:] = PROBATION_EXPOSURES
        return tracks, associations

    def _start(
        self,
        states: ImmStates,
        bias: Array,
        position_mm: Array,
        ambiguous: NDArray[np.bool_],
        exposure: Exposure,
    ) -> Tracks:
        return Tracks.create(
            states,
            bias,
            position_mm,
            first=self.numbers(len(states)),
            marker=exposure.marker,
            time_ns=exposure.time_ns,
            ambiguous_identity=ambiguous,
        )

    def _confirm(
        self,
        tracks: Tracks,
        part: NDArray[np.intp],
        associations: Associations,
        possible_ghosts: NDArray[np.bool_],
        time_ns: int,
    ) -> NDArray[np.bool_]:
        """Confirm tracks, as the lost ones that they are; return which tracks to keep."""
        unreliable = part[possible_ghosts[part]]
        keep = np.ones(len(tracks), dtype=np.bool_)
        sensor_counts = associations.sensor_counts()
        for row in select_confirmed(tracks, self._settings):
            others = part[tracks.confirmed[part] & keep[part]]
            lost = others[tracks.last_detection_ns[others] < time_ns]
            tracks.confirmed[row] = True
            match = match_lost_track(self._motion, tracks, int(row), lost)
            if match is None and sensor_counts[row] >= MIN_SUPPORT_SENSORS:
                ghost = find_replaced_track(
                    associations.peaks, int(row), unreliable[keep[unreliable]]
                )
                match = None if ghost is None else (ghost, True)
            if match is None:
                continue
            old, ambiguous = match
            keep[old] = False
            tracks.identity[row] = tracks.identity[old]
            if tracks.marker[row] < 0:
                tracks.marker[row] = tracks.marker[old]
            tracks.ambiguous_identity[row] |= ambiguous | tracks.ambiguous_identity[old]
        return keep
