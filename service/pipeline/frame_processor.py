"""FrameProcessor: the stages of a frame, in order. Read this file first.

A batch of frames of one device goes through these stages; each takes what the ones before it made:

1. ``detection_stage``: pixels to peaks (position, sigma, width, flags).
2. ``point_stage.weigh_peaks``: peaks to measurements, by the one policy for their flags.
3. ``point_stage.solve_points``: measurements to points: correspondence, then triangulation.
4. ``tracking_stage``: measurements to tracks of markers, then to poses of tools.

Before them stand the reader thread and its ring (``reader_thread``), and the thread that calls them
(``compute_thread``, ``device_session``). Behind them ``device_session`` steps the beam holds
(``beam_hold_registry``), puts up the newest poses (``latest_poses``), offers the batch to taps
(``taps``), and hands it to the streams (``stream_publisher``).
"""

import time
from collections.abc import Sequence

import numpy as np

from compute.calibration.result import Calibration
from compute.errors import InvalidParameter
from compute.mapping.table import CorrectionTable
from compute.reconstruction.point_batch import PointBatch
from compute.reconstruction.solver import load_kernels
from compute.signal.peaks import PeakBatch
from hardware.driver import DeviceDescription
from hardware.line_frame import LineFrame
from service.pipeline.active_calibration import PreparedCalibration
from service.pipeline.compute_thread import limit_blas_threads
from service.pipeline.detection_stage import DetectionStage
from service.pipeline.expected_scans import ExpectedScans, expected_scans
from service.pipeline.frame_batch import FrameBatch
from service.pipeline.point_stage import solve_points, weigh_peaks
from service.pipeline.tracker_factory import TrackerFactory
from service.pipeline.tracking_config import TrackingConfig
from service.pipeline.tracking_stage import TrackingStage

MAX_FRAMES = 64
"""Most frames that are processed together."""


class FrameProcessor:
    """Runs the stages over batches of frames: the same frames give the same bits.

    Made and called in the compute thread; ``set_calibration`` and ``set_tracking_config`` too:
    they prepare what the next batch needs, so that no frame waits for a kernel.
    """

    def __init__(
        self,
        device_id: str,
        description: DeviceDescription,
        compute_device: str | None = None,
        model: ExpectedScans | None = None,
        make: TrackerFactory | None = None,
    ) -> None:
        """Load the kernels.

        Args:
            device_id: the device.
            description: what its driver says of it.
            compute_device: as of FitFinder.
            model: what is known of its scans; None: that of the built-in profile which the
                description names.
            make: makes the trackers of markers and tools; None: those of compute.
        """
        limit_blas_threads()
        self._device_id = device_id
        self._names = tuple(sensor.name for sensor in description.sensors)
        self._active: PreparedCalibration | None = None
        model = expected_scans(description) if model is None else model
        self._detection = DetectionStage(description, MAX_FRAMES, model, compute_device)
        self._compute_device = compute_device
        reads = self._detection.reads
        self._tracking = TrackingStage(device_id, len(self._names), reads=reads, make=make)
        self._is_tracking = False
        self._tracking_s = 0.0
        if reads:
            # Here: what tracks tools loads only where frames are processed.
            from compute.pose.filtering.native.strobed_step import load_kernels as load_steps

            load_kernels(len(self._names), compute_device)
            load_steps(len(self._names))

    @property
    def detection(self) -> DetectionStage:
        """How peaks are found."""
        return self._detection

    @property
    def calibration_id(self) -> str | None:
        """The active calibration."""
        active = self._active
        return active.calibration_id if active else None

    @property
    def table_id(self) -> str | None:
        """The active correction table."""
        active = self._active
        return active.table_id if active else None

    def set_calibration(
        self,
        calibration_id: str | None,
        calibration: Calibration | None,
        table_id: str | None = None,
        table: CorrectionTable | None = None,
    ) -> None:
        """Switch the calibration and its correction table, between two batches.

        Takes milliseconds, unless the calibration has more terms of distortion than any before.

        Raises:
            InvalidParameter: the calibration or the table is of other sensors; the active one
                stays.
        """
        if calibration_id is None or calibration is None:
            self._active = None
            self._tracking.set_calibration(None)
            return
        names = tuple(model.name for model in calibration.models)
        for what, own in (
            (f"calibration {calibration_id}", names),
            (f"correction table {table_id}", table.sensors if table else self._names),
        ):
            if own != self._names:
                raise InvalidParameter(
                    f"{what} is of the sensors {', '.join(own)}; the device has "
                    f"{', '.join(self._names)}"
                )
        self._active = PreparedCalibration.of(
            calibration_id, calibration, table_id, table, self._compute_device
        )
        self._tracking.set_calibration(self._active)

    def set_tracking_config(self, tracked: TrackingConfig) -> None:
        """Switch what is tracked, between two batches; a tool that cannot be tracked says why."""
        self._is_tracking = not tracked.nothing
        self._tracking.set_tracking_config(tracked)

    @property
    def is_tracking(self) -> bool:
        """Whether markers or tools are tracked."""
        return self._is_tracking

    @property
    def tracking_s(self) -> float:
        """Time that tracking took in the newest batch [s]."""
        return self._tracking_s

    def process(
        self, frames: Sequence[LineFrame], *, track: Sequence[bool] | None = None
    ) -> FrameBatch:
        """Run all stages over up to MAX_FRAMES frames.

        A device of which no method can read the scans has neither peaks nor points.

        Args:
            frames: F frames of the device, in their order.
            track: of each frame, whether markers and tools are tracked in it; None: in all. The
                poses of others say that the frame was skipped.
        """
        if len(frames) == 1:
            lines = frames[0].lines
        else:
            lines = np.concatenate([frame.lines for frame in frames])
        return self.process_peaks(frames, self._detection.find(lines), track=track)

    def process_peaks(
        self,
        frames: Sequence[LineFrame],
        peaks: PeakBatch,
        *,
        track: Sequence[bool] | None = None,
    ) -> FrameBatch:
        """Run the stages behind detection; arguments as of ``process``, with the frames' peaks."""
        active = self._active
        measurements = None
        if active is None or not self._detection.reads:
            points, owner = PointBatch.empty(len(self._names)), np.empty(0, dtype=np.intp)
        else:
            measurements = weigh_peaks(active, frames, peaks, self._detection.flag_policy)
            points, owner = solve_points(active, frames, measurements)
        motion = None
        if self._is_tracking:
            begin = time.perf_counter()
            motion = self._tracking.find(frames, measurements, points, owner, track)
            self._tracking_s = time.perf_counter() - begin
        return FrameBatch(
            self._device_id,
            self._names,
            active.calibration_id if active else None,
            active.table_id if active else None,
            tuple(frames),
            peaks,
            points,
            owner,
            motion,
        )
