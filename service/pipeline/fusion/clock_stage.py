"""ClockStage: the errors of the bars' clocks in the measurements, points, tracks and poses.

In place of detection, and around the other stages: peaks are freed of the clock errors that are
known; what is not known of them goes into the covariances of the results; and points of markers
that move refine what is known.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.fusion.clock_errors import (
    ClockSensitivity,
    PointReadings,
    clock_sensitivity,
    correct_points,
)
from compute.fusion.clock_refinement import ClockEstimate, ClockRefinement
from compute.fusion.motion_clock_errors import (
    add_clock_errors_to_pose,
    add_clock_errors_to_tracks,
)
from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements
from compute.pose.rigid_body import RigidBody, ToolPose
from compute.reconstruction.point_batch import PointBatch, PointFlag
from compute.signal.peaks import PeakBatch
from compute.tracking.track_batch import TrackBatch
from hardware.line_frame import LineFrame
from service.pipeline.active_calibration import PreparedCalibration
from service.pipeline.fusion.fused_frame import FusedFrame, join_peaks, rates_of

Array = NDArray[np.float64]

BLOCK_NS: Final = 250_000_000
"""The clocks are refined from the points of that much at once."""
INTERVAL_NS: Final = 4_000_000
"""Of faster devices some frames do: each costs more than its triangulation."""
NEGLIGIBLE_SIGMA: Final = 0.1
"""What clocks do to no reading more than that many of its standard deviations is left out: half a
percent of its point's."""
_DOUBTFUL: Final = int(
    PointFlag.INCONSISTENT
    | PointFlag.AMBIGUOUS
    | PointFlag.SUSPECT_PEAK
    | PointFlag.READING_EXCLUDED
    | PointFlag.NOT_IDENTIFIABLE
)
"""Flags of points of which a reading may be another marker's."""


class ClockStage:
    """Errors of the clocks of a fused device; lives where its frames are processed."""

    def __init__(self) -> None:
        self._clocks = ClockRefinement(np.empty(0))
        self._sigma_s: Array = np.empty(0)
        self._estimate = self._clocks.estimate
        self._learned: list[ClockSensitivity] = []
        self._begin_ns: int | None = None
        self._newest_ns: int | None = None
        self._reference: int | None = None

    @property
    def estimate(self) -> ClockEstimate:
        """The clock errors that peaks are freed of."""
        return self._estimate

    def remark(self, frame: LineFrame, sensor_names: Sequence[str]) -> str | None:
        """Return which clock's error contradicts what is stated of it; None: none does.

        Args:
            frame: a fused frame.
            sensor_names: names of its sensors, the bar's before the first point.
        """
        clocks = np.flatnonzero(self._estimate.contradicted)
        sensors = np.flatnonzero(np.isin(_fused(frame).bar_of_sensor, clocks))
        if not len(sensors):
            return None
        clock = _fused(frame).bar_of_sensor[sensors[0]]
        bar = sensor_names[sensors[0]].partition(".")[0]
        return (
            f'by the motion of markers the clock of "{bar}" is off by '
            f"{1e6 * self._estimate.error_s[clock]:.0f} us, which contradicts its uncertainty of "
            f"{1e6 * self._sigma_s[clock]:.0f} us: state a larger clock_uncertainty_us, or find "
            "what delays its times"
        )

    def _begin(self, frames: Sequence[LineFrame]) -> None:
        """Refine the clocks by what was seen before a batch."""
        first = _fused(frames[0])
        now_ns = first.exposure_host_ns
        if first.reference != self._reference or len(first.clock_sigma_s) != len(self._sigma_s):
            # Errors are those against another clock now.
            self._reference = first.reference
            self._clocks = ClockRefinement(first.clock_sigma_s)
            self._learned, self._begin_ns = [], now_ns
        self._sigma_s = first.clock_sigma_s
        if self._begin_ns is None or now_ns < self._begin_ns:
            self._learned, self._begin_ns = [], now_ns
        elapsed_ns = now_ns - self._begin_ns
        if elapsed_ns >= BLOCK_NS:
            self._clocks.set_sigma(self._sigma_s)
            self._clocks.predict(1e-9 * elapsed_ns)
            for seen in self._join():
                self._clocks.update(seen, self._estimate.error_s)
            self._learned, self._begin_ns = [], now_ns
        self._estimate = self._clocks.estimate

    def _join(self) -> list[ClockSensitivity]:
        """Return what all points of the block tell, as one."""
        if not self._learned:
            return []
        columns = zip(*(vars(one).values() for one in self._learned), strict=True)
        return [ClockSensitivity(*(np.concatenate(column) for column in columns))]

    def correct(self, frames: Sequence[LineFrame]) -> PeakBatch:
        """Begin a batch; return its peaks without the clock errors that are known by then.

        Args:
            frames: fused frames, one or more.
        """
        self._begin(frames)
        peaks = join_peaks(frames)
        error = self._estimate.error_s
        if not error.any():
            return peaks
        position = peaks.position_px.copy()
        first = 0
        for frame in frames:
            fused = _fused(frame)
            last = first + len(fused.peaks)
            late_s = np.append(error, 0.0)[fused.bar_of_sensor]
            position[first:last] += rates_of(fused, position.shape[1]).rate_px_s * late_s[:, None]
            first = last
        return replace(peaks, position_px=position)

    def add_to_points(
        self,
        frames: Sequence[LineFrame],
        measurements: Measurements,
        active: PreparedCalibration,
        points: PointBatch,
        owner: NDArray[np.intp],
    ) -> PointBatch:
        """Return points with the clocks' covariance in theirs; learn from those that are sure.

        Args:
            frames: F fused frames.
            measurements: of these, corrected, shape (F, S, K).
            active: the active calibration.
            points: of the frames.
            owner: index of the frame of each point.
        """
        if not self._sigma_s.any() or not len(points):
            return points
        parts = []
        for index, frame in enumerate(frames):
            chosen = points.rows(owner == index)
            if not len(chosen):
                continue
            parts.append(
                self._add_to_frame(_fused(frame), measurements, index, _model(active), chosen)
            )
        return PointBatch.concatenate(parts)

    def _add_to_frame(
        self,
        frame: FusedFrame,
        measurements: Measurements,
        index: int,
        model: MeasurementModel,
        points: PointBatch,
    ) -> PointBatch:
        exposure = measurements.exposure(index)
        learns = (
            self._newest_ns is None
            or not 0 <= frame.exposure_host_ns - self._newest_ns < INTERVAL_NS
        )
        rates = rates_of(frame, exposure.position_px.shape[1])
        bars = len(self._sigma_s)
        covariance = self._estimate.covariance_s2
        off_px = (
            np.abs(rates.rate_px_s)
            * np.sqrt(np.append(np.diagonal(covariance), 0.0))[frame.bar_of_sensor, None]
        )
        if not learns and (off_px**2 <= NEGLIGIBLE_SIGMA**2 * exposure.variance_px2).all():
            return points
        readings = PointReadings.nearest(model, points, exposure, rates)
        sensitivity = _widen(
            clock_sensitivity(
                model, points, readings, frame.bar_of_sensor, with_common_errors=learns
            ),
            bars,
        )
        grown = correct_points(points, sensitivity, np.zeros(bars), covariance)
        if learns:
            self._newest_ns = frame.exposure_host_ns
            sure = (grown.flags & _DOUBTFUL) == 0
            if sure.any():
                self._learned.append(
                    ClockSensitivity(
                        *(values[sure].sum(axis=0)[None] for values in vars(sensitivity).values())
                    )
                )
        return grown

    def add_to_poses(
        self,
        frames: Sequence[LineFrame],
        active: PreparedCalibration,
        poses: Sequence[Sequence[ToolPose]],
        tools: Sequence[RigidBody],
        max_tip_sd_mm: float,
    ) -> list[Sequence[ToolPose]]:
        """Return the poses of each frame with the clocks' covariance in theirs.

        Args:
            frames: F fused frames.
            active: the active calibration.
            poses: of each frame.
            tools: the tools.
            max_tip_sd_mm: limit of tools without one of their own [mm].
        """
        bodies = {tool.name: tool for tool in tools}
        covariance = self._estimate.covariance_s2
        return [
            [
                add_clock_errors_to_pose(
                    pose,
                    bodies[pose.tool],
                    _model(active),
                    _fused(frame).bar_of_sensor,
                    covariance,
                    max_tip_sd_mm,
                )
                for pose in found
            ]
            for frame, found in zip(frames, poses, strict=True)
        ]

    def add_to_tracks(
        self,
        frames: Sequence[LineFrame],
        active: PreparedCalibration,
        tracks: Sequence[TrackBatch],
    ) -> list[TrackBatch]:
        """Return the tracks after each frame with the clocks' covariance in theirs."""
        covariance = self._estimate.covariance_s2
        return [
            add_clock_errors_to_tracks(
                found, _model(active), _fused(frame).bar_of_sensor, covariance
            )
            for frame, found in zip(frames, tracks, strict=True)
        ]


def _widen(sensitivity: ClockSensitivity, bars: int) -> ClockSensitivity:
    """Return the sensitivity to all bars' clocks; those of bars that are away do nothing."""
    missing = bars - sensitivity.score.shape[1]
    if not missing:
        return sensitivity
    behind, both = (0, missing), ((0, 0), (0, missing), (0, missing))
    return ClockSensitivity(
        np.pad(sensitivity.shift_mm_s, ((0, 0), (0, 0), behind)),
        np.pad(sensitivity.information, both),
        np.pad(sensitivity.by_noise, ((0, 0), behind)),
        np.pad(sensitivity.score, ((0, 0), behind)),
        np.pad(sensitivity.common, ((0, 0), behind, (0, 0))),
    )


def _model(active: PreparedCalibration) -> MeasurementModel:
    assert active.model is not None
    return active.model


def _fused(frame: LineFrame) -> FusedFrame:
    assert isinstance(frame, FusedFrame)
    return frame
