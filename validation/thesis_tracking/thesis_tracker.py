"""The thesis's trackers with the interface of ``Tracker``, exposure by exposure."""

from itertools import count

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.mapping.table import CorrectionTable
from compute.measurement.measurements import Measurements, check_sensors
from compute.tracking.track_batch import TrackBatch
from validation.thesis_tracking.point_reconstruction import SpacePoints
from validation.thesis_tracking.point_tracker import PointTracker
from validation.thesis_tracking.probabilistic_sensor_tracker import ProbabilisticSensorTracker
from validation.thesis_tracking.sensor_track_fusion import SensorTrackFusion
from validation.thesis_tracking.settings import MIN_SENSORS, ThesisSettings
from validation.thesis_tracking.slot_tracker import SlotTracker
from validation.thesis_tracking.track_report import reports_to_track_batch
from validation.thesis_tracking.window_sensor_tracker import WindowSensorTracker

Array = NDArray[np.float64]

_ALL_LIT = -1


class ThesisTracker:
    """Tracks markers by a method of the thesis, with the interface of ``Tracker``.

    - "window" and "probabilistic": tracks along each sensor, then points of equal tracks
      (``SensorTrackFusion``). Velocity and acceleration are differences of the points
      (``FiniteDifferenceKinematics``); ``nis`` is NaN, since the method has no innovation, and
      ``dof`` the number of sensors that saw the marker.
    - "eight-state": tracks in space by [6.11] (``PointTracker``). Acceleration along Z is 0: the
      model has none there, and its rows and columns in the covariance are NaN. ``nis`` is that of
      the point, of three ``dof``; NaN where a point was not predicted.

    A marker is reported from its third point on, when velocity and acceleration are known (by
    "eight-state" from the first on, as tentative). Each strobe slot is followed by itself, so that
    the slot is the identity, as section 6.1 has it of sequential markers; the others are predicted
    meanwhile. Identity numbers are never used again, also not after ``reset``. The same input
    gives the same bits.

    Args:
        cameras: S calibrated cameras, three or more.
        settings: the method, and what it is told.
        parameter_covariance: as of ``reconstruct``; None: cameras are exact.
        corrections: of the S sensors' readings; None: none.
        pixels: of each sensor; None: not known.

    Raises:
        InvalidParameter: fewer than three cameras, or a covariance, a table or pixels of others.
    """

    def __init__(
        self,
        cameras: CameraStack,
        settings: ThesisSettings,
        parameter_covariance: Array | None = None,
        corrections: CorrectionTable | None = None,
        pixels: tuple[int, ...] | None = None,
    ) -> None:
        if len(cameras) < MIN_SENSORS:
            raise InvalidParameter(
                f"there are {len(cameras)} sensors; the method {settings.method} makes points of "
                "the tracks along three sensors or more (take readings, which follows on fewer)"
            )
        self.settings = settings
        self._space = SpacePoints(cameras, parameter_covariance, corrections, pixels)
        self._numbers = count(1)
        self._slot_trackers: dict[int, tuple[SlotTracker, int]] = {}
        self._time_ns: int | None = None

    def reset(self) -> None:
        """Forget all tracks; the next ones have new numbers."""
        self._slot_trackers, self._time_ns = {}, None

    def step(
        self,
        time_ns: int,
        peaks: Measurements,
        marker: int | None,
    ) -> TrackBatch:
        """Return all tracks after one exposure; arguments and errors as of ``Tracker.step``."""
        if self._time_ns is not None and time_ns <= self._time_ns:
            raise InvalidParameter(
                f"time_ns is {time_ns}, the exposure before was at {self._time_ns}; it must be "
                "later (after a jump of the clock, reset the tracker)"
            )
        if marker is not None and marker < 0:
            raise InvalidParameter(f"marker is {marker}; it must be 0 or more, or None")
        check_sensors(peaks, len(self._space.model))
        self._time_ns = time_ns
        # A light that has been dark for so long begins anew: its scans are too far apart.
        limit_ns = 1e9 * self.settings.coast_s
        self._slot_trackers = {
            slot: (slot_tracker, last_ns)
            for slot, (slot_tracker, last_ns) in self._slot_trackers.items()
            if time_ns - last_ns <= limit_ns
        }
        now = _ALL_LIT if marker is None else marker
        lit = (
            self._slot_trackers[now][0]
            if now in self._slot_trackers
            else self._create_slot_tracker(now)
        )
        self._slot_trackers[now] = (lit, time_ns)
        reports = lit.step(time_ns, peaks)
        for slot_tracker, _ in self._slot_trackers.values():
            if slot_tracker is not lit:
                reports += slot_tracker.predicted(time_ns)
        return reports_to_track_batch(reports, peaks)

    def _create_slot_tracker(self, marker: int) -> SlotTracker:
        settings, space = self.settings, self._space

        def number() -> int:
            return next(self._numbers)

        if settings.method == "eight-state":
            return PointTracker(settings, space, marker, number)
        if settings.method == "probabilistic":
            return SensorTrackFusion(
                settings, space, marker, number, lambda: ProbabilisticSensorTracker(settings)
            )
        targets = settings.markers if marker == _ALL_LIT else 1
        return SensorTrackFusion(
            settings, space, marker, number, lambda: WindowSensorTracker(settings, targets)
        )
