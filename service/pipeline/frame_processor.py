"""FrameProcessor: the stages of a frame, in order. Read this file first.

A batch of frames of one device goes through these stages; each takes what the ones before it made:

1. ``detection_stage``: pixels to peaks (position, sigma, width, flags).
2. ``weigh_peaks``: peaks to measurements, by the one policy for their flags.
3. ``tracking_stage``: measurements to poses of tools, which wait for nothing else.
4. ``solve_points``: measurements to points: correspondence, then triangulation. Before the poses
   where all markers are lit together, since tools are then found by points.
5. ``tracking_stage``: measurements to tracks of markers.

Before them stand the threads and the ring between them (``threads``); ``device_session`` takes
frames from it. It publishes the newest poses as soon as they are known; behind the stages it steps
the beam holds (``beam_hold_registry``; those that watch tools alone before the poses), offers the
batch to taps (``taps``), and hands it to the streams.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.measurement.flag_policy import FlagPolicy
from compute.measurement.measurements import Measurements
from compute.reconstruction.correspondence.grouping import group_peaks
from compute.reconstruction.outlier_exclusion import SUSPICIOUS, exclude_outliers
from compute.reconstruction.point_batch import PointBatch, PointFlag
from compute.reconstruction.solver import load_kernels
from compute.signal.peaks import PeakBatch
from compute.warp_host import warp_device
from hardware.driver import DeviceDescription
from hardware.line_frame import LineFrame
from service.pipeline.active_calibration import (
    NO_ACTIVE_CALIBRATION,
    ActiveCalibration,
    PreparedCalibration,
)
from service.pipeline.detection_stage import DetectionStage, ExpectedScans, expected_scans
from service.pipeline.frame_batch import FrameBatch, TrackingResult
from service.pipeline.threads import limit_blas_threads
from service.pipeline.tracking_config import TrackingConfig
from service.pipeline.tracking_stage import TrackingStage

if TYPE_CHECKING:
    from compute.pose.rigid_body import ToolPose
    from service.pipeline.fusion.clock_stage import ClockStage

MAX_FRAMES = 64
"""Most frames that are processed together."""
THREE_SENSORS_REMARK: Final = (
    "the three sensors see several markers lit together: each combination of their peaks meets in "
    "a point, so no point is reported, and no track or tool begins while more than one marker is "
    "not tracked; strobe the markers, light one after the other, or add a fourth sensor"
)
"""Remark on a running device."""
MAX_SIMULTANEOUS_MARKERS: Final = 12
"""Peaks of a sensor up to which markers lit together are told apart, in some milliseconds a frame.
On four sensors more of them are mostly ambiguous, and take longer than frames come."""

TakePoses = Callable[[FrameBatch], None]
"""Takes what is known of a batch once the poses of its tools are."""
Points = tuple[PointBatch, NDArray[np.intp]]
"""Points of a batch, and the index of the frame of each."""


class FrameProcessor:
    """Runs the stages over batches of frames: the same frames give the same bits.

    Made and called in a turn of the ``ComputeThread``; ``set_calibration`` and
    ``set_tracking_config`` too: they prepare what the next batch needs, so that no frame waits for
    a kernel.
    """

    def __init__(
        self,
        device_id: str,
        description: DeviceDescription,
        compute_device: str | None = None,
        model: ExpectedScans | None = None,
    ) -> None:
        """Load the kernels.

        Args:
            device_id: the device.
            description: what its driver says of it.
            compute_device: as of FitFinder.
            model: what is known of its scans; None: that of the built-in profile which the
                description names.
        """
        limit_blas_threads()
        self._device_id = device_id
        self._names = tuple(sensor.name for sensor in description.sensors)
        self._compute_device = compute_device
        self.active_calibration = NO_ACTIVE_CALIBRATION
        """What batches are processed with."""
        self._prepared: PreparedCalibration | None = None
        model = expected_scans(description) if model is None else model
        self.detection = DetectionStage(description, MAX_FRAMES, model, compute_device)
        """How peaks are found."""
        reads = self.detection.reads
        self._tracking = TrackingStage(device_id, len(self._names), reads=reads)
        self._no_points: Points = PointBatch.empty(len(self._names)), np.empty(0, dtype=np.intp)
        self.remark: str | None = None
        """What keeps markers of the newest batch from being found; None: nothing."""
        self.is_tracking = False
        """Whether markers or tools are tracked."""
        self.tracking_s = 0.0
        """Time that tracking took in the newest batch [s]."""
        self._clocks: ClockStage | None = None  # of a fused device
        self.uses_gpu = False
        """Whether frames are processed on a GPU, whose contexts belong to threads."""
        if self.detection.method == "fused":
            from service.pipeline.fusion import clock_stage

            self._clocks = clock_stage.ClockStage()
        if reads:
            import warp as wp

            # Here: what tracks tools loads only where frames are processed.
            from compute.pose.filtering.native.kernel_arguments import load_kernels as load_steps

            load_kernels(len(self._names), compute_device)
            load_steps(len(self._names))
            self.uses_gpu = not warp_device(wp, compute_device).is_cpu

    @property
    def calibration_ids(self) -> tuple[str | None, str | None]:
        """The active calibration and its correction table."""
        prepared = self._prepared
        return (prepared.calibration_id, prepared.table_id) if prepared else (None, None)

    @property
    def radiometric_id(self) -> str | None:
        """The active radiometric calibration."""
        radiometric = self.active_calibration.radiometric
        return None if radiometric is None else radiometric.radiometric_id

    def set_calibration(self, active: ActiveCalibration) -> None:
        """Switch the calibration and its correction table, between two batches.

        Takes milliseconds, unless the calibration has more terms of distortion than any before.

        Raises:
            InvalidParameter: the calibration, the table or the radiometric calibration is of other
                sensors; what is active stays.
        """
        models = active.calibration.models if active.calibration else ()
        for what, sensors in (
            (f"calibration {active.calibration_id}", tuple(model.name for model in models)),
            (f"correction table {active.table_id}", active.table.sensors if active.table else ()),
        ):
            if sensors and sensors != self._names:
                raise InvalidParameter(
                    f"{what} is of the sensors {', '.join(sensors)}; the device has "
                    f"{', '.join(self._names)}"
                )
        earlier, radiometric = self.active_calibration, active.radiometric
        before = earlier.radiometric
        if (before and before.content_hash) != (
            radiometric and radiometric.content_hash
        ) or earlier.bad_pixels != active.bad_pixels:
            # Not at every activation of another calibration: it takes milliseconds.
            self.detection.set_pixels(radiometric.sensors if radiometric else {}, active.bad_pixels)
        if active.differs_in_bad_pixels_only(earlier):
            # Tracks and tools go on.
            self.active_calibration = active
            return
        self._prepared = PreparedCalibration.of(active, self._compute_device)
        self.active_calibration = active
        self._tracking.set_calibration(self._prepared)

    def set_tracking_config(self, tracked: TrackingConfig) -> None:
        """Replace the tracking configuration; tools that cannot be tracked say why."""
        self.is_tracking = not tracked.nothing
        self._tracking.set_tracking_config(tracked)

    def process(
        self,
        frames: Sequence[LineFrame],
        *,
        track: Sequence[bool] | None = None,
        take_poses: TakePoses | None = None,
    ) -> FrameBatch:
        """Run all stages over up to MAX_FRAMES frames.

        A device of which no method can read the scans has neither peaks nor points.

        Args:
            frames: F frames of the device, in their order.
            track: of each frame, whether markers and tools are tracked in it; None: in all. The
                poses of others say that the frame was skipped.
            take_poses: called as soon as the poses of tools are known, with what is known then: a
                batch without tracks, and without points of strobed frames.
        """
        if self._clocks is not None:
            peaks = self._clocks.correct(frames)
            self.remark = self._clocks.remark(frames[-1], self._names)
            return self.process_peaks(
                frames, peaks, track=track, take_poses=take_poses, clocks=self._clocks
            )
        one = len(frames) == 1
        lines = frames[0].lines if one else np.concatenate([frame.lines for frame in frames])
        peaks = self.detection.find(lines)
        return self.process_peaks(frames, peaks, track=track, take_poses=take_poses)

    def process_peaks(
        self,
        frames: Sequence[LineFrame],
        peaks: PeakBatch,
        *,
        track: Sequence[bool] | None = None,
        take_poses: TakePoses | None = None,
        clocks: "ClockStage | None" = None,
    ) -> FrameBatch:
        """Run the stages behind detection; arguments as of ``process``, with the frames' peaks.

        Of fused frames ``clocks`` adds what is not known of their times.
        """
        active = self._prepared if self.detection.reads else None
        measurements = None
        if active is not None:
            measurements = weigh_peaks(active, frames, peaks, self.detection.flag_policy)
        lit = any(frame.marker is None for frame in frames)
        points = self._solve(frames, measurements, clocks) if lit else self._no_points
        poses: Sequence[Sequence[ToolPose]] = ()
        if self.is_tracking:
            begin = time.perf_counter()
            poses = self._tracking.find_poses(frames, measurements, *points, track)
            if clocks is not None and active is not None:
                poses = clocks.add_to_poses(frames, active, poses, *self._tracking.pose_limits())
            self.tracking_s = time.perf_counter() - begin
            if take_poses is not None and poses[-1]:
                early = TrackingResult.of([self._tracking.no_tracks] * len(frames), poses)
                take_poses(self._batch(frames, peaks, points, early))
        if not lit:
            points = self._solve(frames, measurements, clocks)
        motion = None
        if self.is_tracking:
            begin = time.perf_counter()
            tracks = self._tracking.find_tracks(frames, measurements, track)
            if clocks is not None and active is not None:
                tracks = clocks.add_to_tracks(frames, active, tracks)
            motion = TrackingResult.of(tracks, poses)
            self.tracking_s += time.perf_counter() - begin
        return self._batch(frames, peaks, points, motion)

    def _solve(
        self,
        frames: Sequence[LineFrame],
        measurements: Measurements | None,
        clocks: "ClockStage | None",
    ) -> Points:
        """Return the points of the frames; none where there are no measurements."""
        if measurements is None:
            return self._no_points
        assert self._prepared is not None
        if len(self._names) == 3:
            self.remark = _three_sensor_remark(frames, measurements)
        points, owner = solve_points(self._prepared, frames, measurements)
        if clocks is not None:
            points = clocks.add_to_points(frames, measurements, self._prepared, points, owner)
        return points, owner

    def _batch(
        self,
        frames: Sequence[LineFrame],
        peaks: PeakBatch,
        points: Points,
        motion: TrackingResult | None,
    ) -> FrameBatch:
        return FrameBatch(
            self._device_id,
            self._names,
            *self.calibration_ids,
            tuple(frames),
            peaks,
            *points,
            motion,
            radiometric_id=self.radiometric_id,
        )


def _three_sensor_remark(frames: Sequence[LineFrame], measurements: Measurements) -> str | None:
    """Return why three sensors find no marker where several are lit together; None: they do not."""
    together = np.array([frame.marker is None for frame in frames])
    several = together & np.all(measurements.count > 1, axis=1)
    if 2 * np.count_nonzero(several) <= len(frames):
        return None
    return THREE_SENSORS_REMARK


def weigh_peaks(
    active: PreparedCalibration, frames: Sequence[LineFrame], peaks: PeakBatch, policy: FlagPolicy
) -> Measurements:
    """Return the measurements of F frames, by which points, tracks and tools are found.

    The calibration's misfit is in the standard deviations, where no correction table takes it
    away.

    Args:
        active: the active calibration, of S sensors.
        frames: F frames.
        peaks: peaks of their F x S scans, K a scan at most.
        policy: what the peaks' flags mean.

    Returns:
        Measurements of shape (F, S, K).
    """
    noise = active.measurement_noise
    shape = (len(frames), len(noise.sensor_sigma_px), -1)
    position, flags = peaks.position_px.reshape(shape), peaks.flags.reshape(shape)
    # By frame, peak and sensor for the calibration's figures, which are by sensor.
    peak_sigma = peaks.sigma_px.reshape(shape).astype(np.float64).transpose(0, 2, 1)
    sigma = noise.sigma(peak_sigma)
    if active.table_id is not None:
        # The calibration's misfit, which would widen them, is what the table takes away.
        sigma = np.where(np.isfinite(peak_sigma), peak_sigma, sigma)
    amplitude = peaks.amplitude.reshape(shape)
    return Measurements.weigh(position, sigma.transpose(0, 2, 1), flags, amplitude, policy)


def solve_points(
    active: PreparedCalibration, frames: Sequence[LineFrame], measurements: Measurements
) -> Points:
    """Return the points of F frames, and the index of the frame that each belongs to.

    Args:
        active: the active calibration, of S sensors.
        frames: F frames.
        measurements: of the frames, shape (F, S, K).
    """
    strobed = [index for index, frame in enumerate(frames) if frame.marker is not None]
    parts: list[tuple[int, PointBatch]] = []
    if len(strobed) == len(frames):
        points = _solve_strobed(active, measurements).published()
        return points, np.arange(len(frames), dtype=np.intp)
    if strobed:
        points = _solve_strobed(active, measurements.exposure(np.array(strobed)))
        parts += [(frame, points.part(row, row + 1)) for row, frame in enumerate(strobed)]
    for index, frame in enumerate(frames):
        if frame.marker is None:
            parts.append((index, _solve_simultaneous(active, measurements.exposure(index))))
    parts.sort(key=lambda part: part[0])
    owner = np.repeat([index for index, _ in parts], [len(points) for _, points in parts])
    points = PointBatch.concatenate([points for _, points in parts])
    return points.published(), owner.astype(np.intp)


def _solve_strobed(active: PreparedCalibration, measurements: Measurements) -> PointBatch:
    """Return one point for each of the frames, which are all strobed.

    A strobed exposure shows one marker: the brightest peak is it, weaker ones are reflections.
    """
    position = measurements.position_px
    frames, sensors, peaks = position.shape
    # Indices into the flattened arrays: only the chosen peaks are read.
    at = np.arange(0, position.size, peaks).reshape(frames, sensors)
    if peaks > 1:
        light = np.where(measurements.usable, measurements.amplitude, -1.0)
        at += light.argmax(axis=2)
    readings, sigma = position.take(at), np.sqrt(measurements.variance_px2.take(at))
    points = active.solver.solve(readings, sigma)
    if np.count_nonzero(points.flags & int(SUSPICIOUS)):
        # All are one marker's readings: those that contradict the others may be left out.
        points = exclude_outliers(active.solver.solve, points, readings, sigma)
    if not np.count_nonzero(measurements.suspect):
        return points
    return _flag_points(points, None, measurements.suspect.take(at) & points.used)


def _solve_simultaneous(active: PreparedCalibration, measurements: Measurements) -> PointBatch:
    """Return the points of a frame in which all markers are lit."""
    few = int(measurements.count.max(initial=0)) <= MAX_SIMULTANEOUS_MARKERS
    groups = group_peaks(active.solver.solve, measurements, model=active.model if few else None)
    suspect = measurements.suspect
    if not np.count_nonzero(suspect):
        return _flag_points(groups.points, groups.ambiguous, None)
    sensor = np.arange(len(measurements))
    chosen = suspect[sensor, groups.peaks] & (groups.peaks >= 0)
    return _flag_points(groups.points, groups.ambiguous, chosen)


def _flag_points(
    points: PointBatch, ambiguous: NDArray[np.bool_] | None, suspect: NDArray[np.bool_] | None
) -> PointBatch:
    """Return the points with the flags of ambiguous groups (N,) and suspect peaks (N, S)."""
    flags = points.flags
    if ambiguous is not None and ambiguous.any():
        flags = flags | np.where(ambiguous, int(PointFlag.AMBIGUOUS), 0)
    if suspect is not None and suspect.any():
        flags = flags | np.where(suspect.any(axis=1), int(PointFlag.SUSPECT_PEAK), 0)
    return points if flags is points.flags else replace(points, flags=flags.astype(np.int32))
