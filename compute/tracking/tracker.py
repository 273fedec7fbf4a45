"""Tracker: many moving markers, followed directly on the sensors' readings."""

from math import log

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.mapping.table import CorrectionTable
from compute.reconstruction.estimate import PointBatch
from compute.tracking.association import associate
from compute.tracking.frame_peaks import FramePeaks
from compute.tracking.left_over import FoundPoints, find_points
from compute.tracking.life_cycle import confirmable, ended, exchangeable, lost_one
from compute.tracking.motion_model import MotionModels
from compute.tracking.new_states import new_states
from compute.tracking.point_matching import match_points, update_by_points
from compute.tracking.reading_model import ReadingModel
from compute.tracking.report import batch_of
from compute.tracking.seen import Seen
from compute.tracking.settings import TrackerSettings
from compute.tracking.states import combined, predicted
from compute.tracking.track_batch import TrackBatch
from compute.tracking.tracks import Tracks

Array = NDArray[np.float64]

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
        settings: TrackerSettings | None = None,
        parameter_covariance: Array | None = None,
        corrections: CorrectionTable | None = None,
        pixels: tuple[int, ...] | None = None,
    ) -> None:
        # Here and not above: Warp takes a second to load, and the types are used without it.
        from compute.reconstruction.solver import PointSolver

        self.settings = settings or TrackerSettings()
        self.model = ReadingModel(cameras, parameter_covariance, corrections, pixels)
        self.motion = MotionModels.of(self.settings)
        self._solver = PointSolver(cameras, parameter_covariance, corrections, "cpu", threads=1)
        self._next = 1
        self._clear()

    def reset(self) -> None:
        """Forget all tracks; the next ones have new numbers."""
        self._clear()

    def _clear(self) -> None:
        self._tracks = Tracks.empty(len(self.motion), len(self.model))
        self._time_ns: int | None = None
        self._searched_ns: int | None = None

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
        if marker is not None and marker < 0:
            raise InvalidParameter(f"marker is {marker}; it must be 0 or more, or None")
        peaks = FramePeaks.of(
            position_px, sigma_px, peak_flags, len(self.model), self.settings
        )
        self._time_ns = time_ns
        tracks = self._tracks
        seen = Seen.nothing(len(tracks), len(self.model))
        part = self._taking_part(marker)
        self._predict(part, time_ns)
        followed = part[tracks.confirmed[part]]
        free = self._follow(followed, peaks, seen, marker, time_ns)
        self._find(part, seen, peaks, free, marker, time_ns)
        return batch_of(self.model, self.motion, self._tracks, self._seen, peaks, time_ns)

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
        step = (time_ns - tracks.time_ns[rows]) * 1e-9
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
    ) -> NDArray[np.bool_]:
        """Update confirmed tracks; return which peaks they leave free, shape (S, K)."""
        tracks = self._tracks
        free = peaks.usable
        if len(rows) == 0 or not free.any():
            return free
        found = associate(
            self.model,
            self.motion,
            self.settings,
            tracks.states.rows(rows),
            tracks.bias[rows],
            peaks,
        )
        tracks.states.put(rows, found.states)
        seen.peaks[rows], seen.nis[rows] = found.peaks, found.nis
        seen.merged[rows] = found.merged.any(axis=1)
        seen.doubtful[rows] = found.doubtful
        alive = rows[found.evidence >= BEYOND_DOUBT]
        tracks.seen_ns[alive] = time_ns
        if marker is not None:
            known = rows[(found.peaks >= 0).sum(axis=1) >= 3]
            tracks.marker[known] = marker
            tracks.uncertain[known] = False
        else:
            tracks.uncertain[exchangeable(self.motion, tracks, rows)] = True
        return free & ~found.taken

    def _find(
        self,
        part: NDArray[np.intp],
        seen: Seen,
        peaks: FramePeaks,
        free: NDArray[np.bool_],
        marker: int | None,
        time_ns: int,
    ) -> None:
        """Match points of left-over peaks with open tracks, start new ones, confirm and end."""
        tracks = self._tracks
        degrees = seen.degrees()[part]
        open_ = part[(degrees < 3) | ~tracks.confirmed[part]]
        started = None
        last = self._searched_ns
        due = last is None or time_ns - last >= round(self.settings.start_every_s * 1e9)
        if due or len(open_):
            self._searched_ns = time_ns
            points = find_points(self._solve, peaks, free)
            if points is not None:
                started = self._match(open_, points, seen, peaks, marker, time_ns)
        tentative = part[~tracks.confirmed[part]]
        tracks.misses[tentative[seen.degrees()[tentative] == 0]] += 1
        if started is not None:
            self._tracks = tracks = tracks.joined(started)
            seen = seen.joined(self._started_seen)
        keep = self._confirm(part, seen, time_ns)
        keep &= ~ended(tracks, self.settings, time_ns)
        if not keep.all():
            self._tracks, seen = tracks.rows(keep), seen.rows(keep)
        self._seen = seen

    def _match(
        self,
        open_: NDArray[np.intp],
        points: FoundPoints,
        seen: Seen,
        peaks: FramePeaks,
        marker: int | None,
        time_ns: int,
    ) -> Tracks | None:
        """Update open tracks by their points; return the tracks that the others start."""
        tracks, settings = self._tracks, self.settings
        rows, columns = match_points(self.motion, tracks.states.rows(open_), points)
        rows = open_[rows]
        sensor = np.arange(len(self.model))
        if len(rows):
            chosen = points.peaks[columns]
            at = np.maximum(chosen, 0)
            # A sensor whose peak the track has already says nothing new.
            new = (chosen >= 0) & (seen.peaks[rows] < 0)
            update = update_by_points(
                self.model,
                self.motion,
                settings,
                tracks.states.rows(rows),
                tracks.bias[rows],
                np.where(new, peaks.position_px[sensor, at], np.nan),
                peaks.variance_px2[sensor, at],
                points.position_mm[columns],
            )
            tracks.states.put(rows, update.states)
            seen.peaks[rows] = np.where(new, chosen, seen.peaks[rows])
            seen.nis[rows] += update.nis
            tracks.hits[rows] += 1
            tracks.evidence[rows] += update.evidence
            tracks.seen_ns[rows] = time_ns
            doubt = points.ambiguous[columns]
            tracks.uncertain[rows] = np.where(
                tracks.confirmed[rows],
                tracks.uncertain[rows] | doubt,
                tracks.uncertain[rows] & doubt,
            )
            if marker is not None:
                tracks.marker[rows] = marker
        others = np.setdiff1d(np.arange(len(points)), columns)
        if marker is not None:
            known = tracks.confirmed & (tracks.marker == marker)
            if (known & (seen.degrees() >= 3)).any():
                return None
        if len(others) == 0:
            return None
        return self._start(points, others, marker, time_ns)

    def _start(
        self, points: FoundPoints, rows: NDArray[np.intp], marker: int | None, time_ns: int
    ) -> Tracks:
        """Return tentative tracks at these points."""
        place = points.position_mm[rows]
        states, bias = new_states(
            self.model, self.motion, self.settings, place, points.sigma_px[rows]
        )
        count = len(rows)
        identity = np.arange(self._next, self._next + count, dtype=np.int64)
        self._next += count
        started = Seen.nothing(count, len(self.model))
        started.peaks[:] = points.peaks[rows]
        self._started_seen = started
        return Tracks(
            states,
            identity,
            np.full(count, -1 if marker is None else marker, dtype=np.int32),
            np.zeros(count, dtype=np.bool_),
            points.ambiguous[rows].copy(),
            np.full(count, time_ns, dtype=np.int64),
            np.full(count, time_ns, dtype=np.int64),
            np.zeros(count, dtype=np.int32),
            np.zeros(count, dtype=np.int32),
            np.zeros(count),
            bias,
            place,
        )

    def _confirm(
        self, part: NDArray[np.intp], seen: Seen, time_ns: int
    ) -> NDArray[np.bool_]:
        """Confirm tracks, as the lost ones that they are; return which tracks to keep."""
        tracks = self._tracks
        keep = np.ones(len(tracks), dtype=np.bool_)
        for row in confirmable(tracks, self.settings):
            lost = part[tracks.confirmed[part] & (tracks.seen_ns[part] < time_ns) & keep[part]]
            tracks.confirmed[row] = True
            found = lost_one(self.motion, tracks, int(row), lost)
            if found is None:
                continue
            old, ambiguous = found
            keep[old] = False
            tracks.identity[row] = tracks.identity[old]
            if tracks.marker[row] < 0:
                tracks.marker[row] = tracks.marker[old]
            tracks.uncertain[row] |= ambiguous | tracks.uncertain[old]
        return keep

    def _solve(self, readings_px: Array, sigma_px: Array) -> PointBatch:
        return self._solver.solve(readings_px, np.where(np.isfinite(sigma_px), sigma_px, 1.0))
