"""Tracker: multi-target tracking on the sensors' readings."""

from math import log

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.mapping.table import CorrectionTable
from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements, check_sensors
from compute.reconstruction.correspondence.candidates import MatchSettings
from compute.reconstruction.solver import PointSolver
from compute.tracking.motion_model import MotionModels, mean_positions
from compute.tracking.native.kernels import Associator, Predictor
from compute.tracking.settings import TrackerSettings
from compute.tracking.state_initialisation import check_prior, states_from_prior
from compute.tracking.track_batch import TrackBatch
from compute.tracking.track_initiation import TrackInitiator
from compute.tracking.track_management import exclude_prior_duplicates, indistinguishable_tracks
from compute.tracking.tracks import (
    MIN_SUPPORT_SENSORS,
    AssociationResult,
    Associations,
    Exposure,
    Tracks,
    to_track_batch,
)
from compute.tracking.unassociated_points import UnassociatedPointFinder
from compute.tracking.unresolved_neighbours import (
    any_neighbour,
    inflate_unresolved,
    predict_merged,
    update_neighbours,
)

Array = NDArray[np.float64]

STANDARD = TrackerSettings()
ALIVE_LOG_LIKELIHOOD_RATIO = log(1000.0)
"""Evidence of one exposure that a confirmed track lives."""
BIAS_UPDATE_DISTANCE_MM = 5.0
"""A marker that moved so far has the calibration's errors worked out anew."""


class Tracker:
    """Tracks markers by Kalman filters on readings, with joint probabilistic data association.

    Identity numbers are never used again, also not after ``reset``. The same input gives the same
    bits.

    Args:
        cameras: S calibrated cameras.
        settings: what is assumed.
        parameter_covariance: as of ``reconstruct``; None: cameras are exact.
        corrections: of the S sensors' readings; None: none.
        pixels: of each sensor; None: no prediction is taken to be out of view.

    Raises:
        InvalidParameter: a covariance, a table or pixels of other sensors.
    """

    def __init__(
        self,
        cameras: CameraStack,
        settings: TrackerSettings = STANDARD,
        parameter_covariance: Array | None = None,
        corrections: CorrectionTable | None = None,
        pixels: tuple[int, ...] | None = None,
    ) -> None:
        self.settings = settings
        self.motion = MotionModels.of(settings)
        self._pixels = pixels
        self._predictor = Predictor(self.motion, len(cameras))
        self._initiator = TrackInitiator(*self._build(cameras, parameter_covariance, corrections))
        self.reset()

    def _build(
        self,
        cameras: CameraStack,
        parameter_covariance: Array | None,
        corrections: CorrectionTable | None,
    ) -> tuple[UnassociatedPointFinder, Associator]:
        self.model = MeasurementModel(cameras, parameter_covariance, corrections, self._pixels)
        self._associator = Associator(self.model, self.motion, self.settings)
        solver = PointSolver(cameras, parameter_covariance, corrections, "cpu", threads=1)
        finder = UnassociatedPointFinder(
            lambda readings, sigma: solver.solve(readings, np.where(sigma > 0.0, sigma, 1.0)),
            self.model,
            MatchSettings(
                self.settings.detection_probability, self.settings.clutter_density_per_px
            ),
        )
        return finder, self._associator

    def set_cameras(
        self,
        cameras: CameraStack,
        parameter_covariance: Array | None = None,
        corrections: CorrectionTable | None = None,
    ) -> None:
        """Switch to another calibration of the same sensors; tracks are kept.

        What the old calibration's errors had made of the tracks stays in their covariances; their
        covariance with the new one's errors begins at zero.

        Args:
            cameras: S calibrated cameras.
            parameter_covariance: joint covariance of their parameters, shape (P, P); None: exact.
            corrections: correction table of the S sensors; None: none.

        Raises:
            InvalidParameter: another number of sensors, or as of the constructor.
        """
        if len(cameras) != len(self.model):
            raise InvalidParameter(
                f"there are {len(cameras)} cameras; the tracker is for {len(self.model)}"
            )
        self._initiator.set_cameras(*self._build(cameras, parameter_covariance, corrections))
        self._tracks.states.bias_cross_covariance[:] = 0.0
        self._tracks.bias[:] = 0.0
        self._tracks.bias_mm[:] = np.inf

    def reset(self) -> None:
        """Delete all tracks; identity numbers continue."""
        self._tracks = Tracks.empty(len(self.model), len(self.motion))
        self._time_ns: int | None = None
        self._begun_ns: int | None = None
        self._last_ns: int | None = None
        self._initiator.reset()

    def add_prior_tracks(
        self,
        time_ns: int,
        position_mm: Array,
        velocity_mm_s: Array,
        covariance: Array,
        marker: int | None = None,
    ) -> NDArray[np.int64]:
        """Add confirmed tracks of markers with known positions; return their identity numbers.

        For positions that are known by other means: from a set-up, or a frame of markers (thesis,
        section 7.2.2). They are looked for in the exposures from then on; those that are not seen
        within ``coast_s`` end. Tentative tracks that may be the same markers give way.

        Args:
            time_ns: when they are there; not before the last exposure, which may be the next one.
            position_mm: shape (N, 3).
            velocity_mm_s: shape (N, 3); zeros for markers at rest.
            covariance: of position and velocity, shape (N, 6, 6), or (6, 6) for each.
            marker: strobe slot, of a single marker; None: not known.

        Raises:
            InvalidParameter: other shapes, values that are not finite, a covariance that is not
                positive definite, a time before the last exposure's, several markers with one
                strobe slot, or a marker that may be one that is tracked already.
        """
        mean, covariance = check_prior(position_mm, velocity_mm_s, covariance)
        last = max((t for t in (self._time_ns, self._begun_ns) if t is not None), default=time_ns)
        if time_ns < last:
            raise InvalidParameter(
                f"time_ns is {time_ns}, the exposure or start before was at {last}; it must not be "
                "earlier"
            )
        if marker is not None and (marker < 0 or len(mean) > 1):
            raise InvalidParameter(
                f"marker is {marker} for {len(mean)} markers; it must be 0 or more, for one"
            )
        states = states_from_prior(self.motion, self.settings, mean, covariance, len(self.model))
        self._predict(np.arange(len(self._tracks)), time_ns)
        self._tracks = self._tracks.rows(
            exclude_prior_duplicates(self.motion, self._tracks, states, mean[:, :3])
        )
        begun = Tracks.create(
            states,
            self.model.systematic_covariance(mean[:, :3]),
            mean[:, :3],
            first=self._initiator.numbers(len(mean)),
            marker=marker,
            time_ns=time_ns,
            ambiguous_identity=np.zeros(len(mean), dtype=np.bool_),
        )
        begun.confirmed[:] = True
        self._tracks = Tracks.concatenate([self._tracks, begun])
        self._begun_ns = time_ns
        return begun.identity.copy()

    def step(
        self,
        time_ns: int,
        peaks: Measurements,
        marker: int | None,
    ) -> TrackBatch:
        """Return all tracks after one exposure.

        Args:
            time_ns: middle of the exposure [ns], later than the last one's.
            peaks: the peaks of the S sensors.
            marker: strobe slot that was lit; None: all markers.

        Raises:
            InvalidParameter: peaks of other sensors, a time that is not later, or a negative
                marker.
        """
        check_sensors(peaks, len(self.model))
        if self._time_ns is not None and time_ns <= self._time_ns:
            raise InvalidParameter(
                f"time_ns is {time_ns}, the exposure before was at {self._time_ns}; it must be "
                "later (after a jump of the clock, reset the tracker)"
            )
        if self._begun_ns is not None and time_ns < self._begun_ns:
            raise InvalidParameter(
                f"time_ns is {time_ns}, markers were given for {self._begun_ns}; it must not be "
                "earlier"
            )
        if marker is not None and marker < 0:
            raise InvalidParameter(f"marker is {marker}; it must be 0 or more, or None")
        self._last_ns, self._time_ns = self._time_ns, time_ns
        tracks, exposure = self._tracks, Exposure(time_ns, peaks, marker)
        associations = Associations.missed(len(tracks), len(self.model))
        part = self._visible_rows(marker)
        self._predict(part, time_ns)
        confirmed = part[tracks.confirmed[part]]
        self._update_confirmed(confirmed, associations, exposure)
        free = associations.free_peaks(peaks)
        if marker is None:
            self._update_neighbours(confirmed, associations, free, exposure)
        self._tracks, associations = self._initiator.find(
            tracks, part, associations, exposure, free
        )
        step = np.asarray((time_ns - self._tracks.time_ns) * 1e-9, dtype=np.float64)
        combined = self._predictor.combined(self._tracks.states, step)
        return to_track_batch(
            self.model, self._tracks, combined, associations, exposure,
            acceleration=any(self.motion.has_acceleration),
        )  # fmt: skip

    def _visible_rows(self, marker: int | None) -> NDArray[np.intp]:
        """Return the rows of tracks that this exposure may show."""
        tracks = self._tracks
        if marker is None:
            return np.arange(len(tracks))
        part = tracks.marker == marker
        if not (part & tracks.confirmed).any():
            # One that was found while all were lit, and is not known by its marker yet.
            part |= tracks.confirmed & (tracks.marker < 0)
        return np.flatnonzero(part)

    def _predict(self, rows: NDArray[np.intp], time_ns: int) -> None:
        tracks = self._tracks
        if len(rows) == 0:
            return
        step = np.asarray((time_ns - tracks.time_ns[rows]) * 1e-9, dtype=np.float64)
        states = self._predictor.predict(tracks.states.rows(rows), step)
        tracks.time_ns[rows] = time_ns
        if not self.model.exact:
            position_mm = mean_positions(states)
            moved = np.abs(position_mm - tracks.bias_mm[rows]).max(axis=1) > BIAS_UPDATE_DISTANCE_MM
            if moved.any():
                # The errors there are about as large, and of the same cause.
                stale = rows[moved]
                bias = self.model.systematic_covariance(position_mm[moved])
                diagonal = np.arange(len(self.model))
                before = tracks.bias[stale][:, diagonal, diagonal]
                ratio = bias[:, diagonal, diagonal] / np.where(before > 0.0, before, np.inf)
                states.bias_cross_covariance[moved] *= np.sqrt(ratio)[:, None, None]
                tracks.bias[stale], tracks.bias_mm[stale] = bias, position_mm[moved]
        tracks.states.put(rows, states)

    def _update_confirmed(
        self, rows: NDArray[np.intp], associations: Associations, exposure: Exposure
    ) -> None:
        """Update confirmed tracks."""
        tracks, peaks, marker = self._tracks, exposure.peaks, exposure.marker
        if len(rows) == 0 or not peaks.usable.any():
            return
        inflated = self._inflate_unresolved(rows, exposure)
        association = self._associator.associate(
            tracks.states.rows(rows), tracks.bias[rows], inflated
        )
        tracks.states.put(rows, association.states)
        associations.peaks[rows], associations.nis[rows] = association.peaks, association.nis
        associations.merged[rows] = association.merged.any(axis=1)
        associations.hypotheses_pruned[rows] = association.hypotheses_pruned
        sensor_counts = (association.peaks >= 0).sum(axis=1)
        possible = self._count_possible_sensors(association, sensor_counts, peaks)
        tracks.update_support(rows, sensor_counts, possible, association.in_view)
        alive = rows[association.log_likelihood_ratio >= ALIVE_LOG_LIKELIHOOD_RATIO]
        tracks.last_detection_ns[alive] = exposure.time_ns
        if marker is not None:
            identified = rows[sensor_counts >= 3]
            tracks.marker[identified] = marker
            tracks.ambiguous_identity[identified] = False
        else:
            tracks.ambiguous_identity[indistinguishable_tracks(self.motion, tracks, rows)] = True

    def _inflate_unresolved(self, rows: NDArray[np.intp], exposure: Exposure) -> Measurements:
        """Return the peaks, less certain where one that is not tracked may be merged with them."""
        tracks, peaks = self._tracks, exposure.peaks
        if not tracks.neighbours[rows, :, 2].any() or self._last_ns is None:
            return peaks
        step = np.full(len(rows), (exposure.time_ns - self._last_ns) * 1e-9)
        hidden = predict_merged(tracks.neighbours[rows], step, self.settings)
        some = np.flatnonzero(hidden.any(axis=1))
        if len(some) == 0:
            return peaks
        reading = self.model.predict(mean_positions(tracks.states)[rows[some]]).reading_px
        return inflate_unresolved(peaks, reading, hidden[some], self.settings)

    def _update_neighbours(
        self,
        rows: NDArray[np.intp],
        associations: Associations,
        free: NDArray[np.bool_],
        exposure: Exposure,
    ) -> None:
        """Update the untracked peaks beside those of tracks."""
        tracks, peaks, time_ns = self._tracks, exposure.peaks, exposure.time_ns
        if len(rows) == 0:
            return
        any_known = tracks.neighbours[rows, :, 2].any()
        if not any_known and not any_neighbour(
            associations.peaks[rows], peaks, free, self.settings
        ):
            return
        before = time_ns if self._last_ns is None else self._last_ns
        step = np.full(len(rows), (time_ns - before) * 1e-9)
        tracks.neighbours[rows] = update_neighbours(
            tracks.neighbours[rows], associations.peaks[rows], peaks, free, step, self.settings
        )

    def _count_possible_sensors(
        self,
        association: AssociationResult,
        sensor_counts: NDArray[np.integer],
        peaks: Measurements,
    ) -> NDArray[np.integer]:
        """Return how many sensors saw each track, or have a peak there that it may share, (T,)."""
        possible = sensor_counts.copy()
        few = np.flatnonzero(
            (sensor_counts < MIN_SUPPORT_SENSORS) & (association.in_view >= MIN_SUPPORT_SENSORS)
        )
        if len(few):
            reading = self.model.predict(mean_positions(association.states)[few]).reading_px
            shared = peaks.is_near(reading, self.settings.resolution_px)
            possible[few] = ((association.peaks[few] >= 0) | shared).sum(axis=1)
        return possible
