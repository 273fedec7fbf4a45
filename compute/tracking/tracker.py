"""Tracker: many moving markers, followed directly on the sensors' readings."""

from math import log

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.mapping.table import CorrectionTable
from compute.reconstruction.correspondence import MatchSettings, Predictor
from compute.tracking.frame_peaks import FramePeaks
from compute.tracking.given_starts import GivenStarts
from compute.tracking.left_over import PointFinder
from compute.tracking.life_cycle import VOUCHING_SENSORS, count_weak, exchangeable, not_taken
from compute.tracking.motion_model import MotionModels
from compute.tracking.new_states import given_states
from compute.tracking.newcomers import Newcomers, free_peaks
from compute.tracking.reading_model import ReadingModel
from compute.tracking.report import batch_of
from compute.tracking.seen import Seen
from compute.tracking.settings import TrackerSettings
from compute.tracking.states import States, combined, places, predicted
from compute.tracking.strangers import any_near, beside_after, doubted, hidden_now
from compute.tracking.track_batch import TrackBatch
from compute.tracking.tracks import Tracks

Array = NDArray[np.float64]

STANDARD = TrackerSettings()
BEYOND_DOUBT = log(1000.0)
"""Evidence of one exposure that a confirmed track lives."""
STALE_MM = 5.0
"""A marker that moved so far has the calibration's errors worked out anew."""


class Tracker:
    """Follows markers from peaks alone: Kalman filters on readings, joint association.

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
        self.model, finder = self._made(cameras, parameter_covariance, corrections, pixels)
        self._newcomers = Newcomers(self.model, self.motion, settings, finder, self._associator)
        self._tracks = Tracks.empty(len(self.motion), len(self.model))
        self._time_ns: int | None = None
        self._begun_ns: int | None = None
        self._last_ns: int | None = None

    def _made(
        self,
        cameras: CameraStack,
        parameter_covariance: Array | None,
        corrections: CorrectionTable | None,
        pixels: tuple[int, ...] | None,
    ) -> tuple[ReadingModel, PointFinder]:
        # Here and not above: Warp takes a second to load, and the types are used without it.
        from compute.reconstruction.solver import PointSolver
        from compute.tracking.native.associator import Associator

        model = ReadingModel(cameras, parameter_covariance, corrections, pixels)
        self._associator = Associator(model, self.motion, self.settings)
        solver = PointSolver(cameras, parameter_covariance, corrections, "cpu", threads=1)
        finder = PointFinder(
            lambda readings, sigma: solver.solve(readings, np.where(sigma > 0.0, sigma, 1.0)),
            Predictor(cameras, parameter_covariance, corrections, pixels),
            MatchSettings(self.settings.detection, self.settings.false_per_px),
        )
        return model, finder

    def set_cameras(
        self,
        cameras: CameraStack,
        parameter_covariance: Array | None = None,
        corrections: CorrectionTable | None = None,
    ) -> None:
        """Go on with another calibration of the same sensors; tracks are kept.

        What the old calibration's errors had made of the tracks stays in their covariances; their
        covariance with the new one's errors begins at none.

        Raises:
            InvalidParameter: another number of sensors, or as of the constructor.
        """
        if len(cameras) != len(self.model):
            raise InvalidParameter(
                f"there are {len(cameras)} cameras; the tracker is for {len(self.model)}"
            )
        self.model, finder = self._made(cameras, parameter_covariance, corrections, self._pixels)
        self._newcomers.renew(self.model, finder, self._associator)
        self._tracks.states.with_bias[:] = 0.0
        self._tracks.bias[:] = 0.0
        self._tracks.bias_mm[:] = np.inf

    def reset(self) -> None:
        """Forget all tracks; the next ones have new numbers."""
        self._tracks = Tracks.empty(len(self.motion), len(self.model))
        self._time_ns = self._begun_ns = None
        self._newcomers.reset()

    def begin_at(
        self,
        time_ns: int,
        position_mm: Array,
        velocity_mm_s: Array,
        covariance: Array,
        marker: int | None = None,
    ) -> NDArray[np.int64]:
        """Begin confirmed tracks of markers that are known to be there; return their numbers.

        For places that are known by other means: from a set-up, or of a frame of markers (thesis,
        section 7.2.2). They are looked for in the exposures from then on; those that are not seen
        within ``coast_s`` end. Tentative tracks that may be the same markers give way.

        Args:
            time_ns: when they are there; not before the last exposure, which may be the next one.
            position_mm: shape (N, 3).
            velocity_mm_s: shape (N, 3); zeros for markers at rest.
            covariance: of place and velocity, shape (N, 6, 6), or (6, 6) for each.
            marker: strobe slot, of a single marker; None: not known.

        Raises:
            InvalidParameter: other shapes, values that are not finite, a covariance that is not
                positive definite, a time before the last exposure's, several markers with one
                strobe slot, or a marker that may be one that is tracked already.
        """
        starts = GivenStarts.of(position_mm, velocity_mm_s, covariance)
        last = max((t for t in (self._time_ns, self._begun_ns) if t is not None), default=time_ns)
        if time_ns < last:
            raise InvalidParameter(
                f"time_ns is {time_ns}, the exposure or start before was at {last}; it must not be "
                "earlier"
            )
        if marker is not None and (marker < 0 or len(starts) > 1):
            raise InvalidParameter(
                f"marker is {marker} for {len(starts)} markers; it must be 0 or more, for one"
            )
        states = given_states(
            self.motion, self.settings, starts.mean, starts.covariance, len(self.model)
        )
        self._predict(np.arange(len(self._tracks)), time_ns)
        self._tracks = self._tracks.rows(
            not_taken(self.motion, self._tracks, states, starts.mean[:, :3])
        )
        begun = Tracks.begun(
            states,
            self.model.bias_covariance(starts.mean[:, :3]),
            starts.mean[:, :3],
            first=self._newcomers.numbers(len(starts)),
            marker=marker,
            time_ns=time_ns,
            confirmed=True,
            uncertain=np.zeros(len(starts), dtype=np.bool_),
        )
        self._tracks = self._tracks.joined(begun)
        self._begun_ns = time_ns
        return begun.identity.copy()

    def step(
        self,
        time_ns: int,
        position_px: Array,
        sigma_px: Array,
        peak_flags: NDArray[np.int32],
        marker: int | None,
    ) -> TrackBatch:
        """Return all tracks after one exposure.

        Args:
            time_ns: of the exposure's middle, later than the last one's.
            position_px: peaks of each sensor, shape (S, K); NaN where there are fewer than K.
            sigma_px: their standard deviations, shape (S, K).
            peak_flags: PeakFlag values, shape (S, K).
            marker: the one that was lit; None: all were.

        Raises:
            InvalidParameter: other shapes, a time that is not later, a negative marker, or a
                standard deviation that is not above 0.
        """
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
        peaks = FramePeaks.of(position_px, sigma_px, peak_flags, len(self.model), self.settings)
        self._last_ns, self._time_ns = self._time_ns, time_ns
        tracks = self._tracks
        seen = Seen.nothing(len(tracks), len(self.model))
        part = self._taking_part(marker)
        self._predict(part, time_ns)
        followed = part[tracks.confirmed[part]]
        self._follow(followed, peaks, seen, marker, time_ns)
        free = free_peaks(peaks, seen, np.zeros(len(tracks), dtype=np.bool_))
        if marker is None:
            self._note_strangers(followed, peaks, seen, free, time_ns)
        self._tracks, seen = self._newcomers.find(tracks, part, seen, peaks, free, marker, time_ns)
        return batch_of(self.model, self.motion, self._tracks, seen, peaks, time_ns)

    def _taking_part(self, marker: int | None) -> NDArray[np.intp]:
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
        states = predicted(self.motion, tracks.states.rows(rows), step)
        tracks.time_ns[rows] = time_ns
        if not self.model.exact:
            place = combined(self.motion, states).mean[:, :3]
            moved = np.abs(place - tracks.bias_mm[rows]).max(axis=1) > STALE_MM
            if moved.any():
                # The errors there are about as large, and of the same cause.
                stale = rows[moved]
                bias = self.model.bias_covariance(place[moved])
                diagonal = np.arange(len(self.model))
                before = tracks.bias[stale][:, diagonal, diagonal]
                ratio = bias[:, diagonal, diagonal] / np.where(before > 0.0, before, np.inf)
                states.with_bias[moved] *= np.sqrt(ratio)[:, None, None]
                tracks.bias[stale], tracks.bias_mm[stale] = bias, place[moved]
        tracks.states.put(rows, states)

    def _follow(
        self,
        rows: NDArray[np.intp],
        peaks: FramePeaks,
        seen: Seen,
        marker: int | None,
        time_ns: int,
    ) -> None:
        """Update confirmed tracks."""
        tracks = self._tracks
        if len(rows) == 0 or not peaks.usable.any():
            return
        weighed = self._doubted(rows, peaks, time_ns)
        found = self._associator.associate(tracks.states.rows(rows), tracks.bias[rows], weighed)
        tracks.states.put(rows, found.states)
        seen.peaks[rows], seen.nis[rows] = found.peaks, found.nis
        seen.merged[rows] = found.merged.any(axis=1)
        seen.doubtful[rows] = found.doubtful
        degrees = (found.peaks >= 0).sum(axis=1)
        possible = self._possible(found.states, found.peaks, degrees, found.in_view, peaks)
        count_weak(tracks, rows, degrees, possible, found.in_view)
        alive = rows[found.evidence >= BEYOND_DOUBT]
        tracks.seen_ns[alive] = time_ns
        if marker is not None:
            known = rows[degrees >= 3]
            tracks.marker[known] = marker
            tracks.uncertain[known] = False
        else:
            tracks.uncertain[exchangeable(self.motion, tracks, rows)] = True

    def _doubted(self, rows: NDArray[np.intp], peaks: FramePeaks, time_ns: int) -> FramePeaks:
        """Return the peaks, less certain where one that is not tracked may be merged with them."""
        tracks = self._tracks
        if not tracks.beside[rows, :, 2].any() or self._last_ns is None:
            return peaks
        step = np.full(len(rows), (time_ns - self._last_ns) * 1e-9)
        hidden = hidden_now(tracks.beside[rows], step, self.settings)
        some = np.flatnonzero(hidden.any(axis=1))
        if len(some) == 0:
            return peaks
        reading = self.model.predict(places(tracks.states)[rows[some]]).reading_px
        return doubted(peaks, reading, hidden[some], self.settings)

    def _note_strangers(
        self,
        rows: NDArray[np.intp],
        peaks: FramePeaks,
        seen: Seen,
        free: NDArray[np.bool_],
        time_ns: int,
    ) -> None:
        """Note the peaks that are no track's beside those that are."""
        tracks = self._tracks
        if len(rows) == 0:
            return
        known = tracks.beside[rows, :, 2].any()
        if not known and not any_near(seen.peaks[rows], peaks, free, self.settings):
            return
        before = time_ns if self._last_ns is None else self._last_ns
        step = np.full(len(rows), (time_ns - before) * 1e-9)
        tracks.beside[rows] = beside_after(
            tracks.beside[rows], seen.peaks[rows], peaks, free, step, self.settings
        )

    def _possible(
        self,
        states: States,
        own: NDArray[np.int32],
        degrees: NDArray[np.integer],
        in_view: NDArray[np.int32],
        peaks: FramePeaks,
    ) -> NDArray[np.integer]:
        """Return how many sensors saw each track, or have a peak there that it may share, (T,)."""
        possible = degrees.copy()
        few = np.flatnonzero((degrees < VOUCHING_SENSORS) & (in_view >= VOUCHING_SENSORS))
        if len(few):
            reading = self.model.predict(places(states)[few]).reading_px
            with np.errstate(invalid="ignore"):
                apart = np.abs(peaks.position_px - reading[..., None])
                shared = ((apart <= self.settings.merge_px) & peaks.usable).any(axis=2)
            possible[few] = ((own[few] >= 0) | shared).sum(axis=1)
        return possible
