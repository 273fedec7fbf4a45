"""Frames of one device to peaks and points, with the calibration in force."""

import time
from collections.abc import Sequence

import numpy as np

from compute.calibration.result import Calibration
from compute.errors import InvalidParameter
from compute.mapping.table import CorrectionTable
from compute.reconstruction.correspondence import Predictor
from compute.reconstruction.solver import PointSolver, load_kernels
from compute.signal.peaks import PeakBatch
from hardware.driver import DeviceDescription
from hardware.line_frame import LineFrame
from service.pipeline.blas_threads import limit_blas_threads
from service.pipeline.detection_stage import DetectionStage
from service.pipeline.expected_scans import ExpectedScans, expected_scans
from service.pipeline.frame_batch import FrameBatch
from service.pipeline.point_stage import CalibrationSolver, no_points, points_of, usable_peaks
from service.pipeline.tracker_factory import TrackerFactory
from service.pipeline.tracking_config import TrackingConfig
from service.pipeline.tracking_stage import TrackingStage

MAX_FRAMES = 64
"""Frames that are processed together, at most, when they have piled up."""


class FrameProcessor:
    """Pure function of frames, calibration and correction table, with the buffers that it needs.

    Made and called in the compute thread, ``set_calibration`` and ``set_tracking_config`` too: they make
    what the next batch is worked on with, so that no frame waits for a kernel.
    """

    def __init__(
        self,
        device_id: str,
        description: DeviceDescription,
        compute_device: str | None = None,
        model: ExpectedScans | None = None,
        make: TrackerFactory | None = None,
    ) -> None:
        """Load what finds the peaks; ``compute_device`` as of FitFinder.

        Without a model, it is that of the built-in profile that the description names. ``make``
        makes what follows markers and tools; None: what compute has.
        """
        limit_blas_threads()
        self._device_id = device_id
        self._names = tuple(sensor.name for sensor in description.sensors)
        self._active: CalibrationSolver | None = None
        model = expected_scans(description) if model is None else model
        self._finding = DetectionStage(description, MAX_FRAMES, model, compute_device)
        self._compute_device = compute_device
        self._tracking_s = 0.0
        self._motion = TrackingStage(
            device_id, len(self._names), reads=self._finding.reads, make=make
        )
        if self._finding.reads:
            # Here: what follows tools loads only where frames are processed.
            from compute.pose.filtering.native.strobed_step import load_kernels as load_steps

            load_kernels(len(self._names), compute_device)
            load_steps(len(self._names))

    @property
    def finding(self) -> DetectionStage:
        """How peaks are found."""
        return self._finding

    @property
    def calibration_id(self) -> str | None:
        """The calibration in force."""
        active = self._active
        return active.calibration_id if active else None

    @property
    def table_id(self) -> str | None:
        """The correction table in force."""
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
            InvalidParameter: the calibration or the table is of other sensors; that in force
                stays.
        """
        if calibration_id is None or calibration is None:
            self._active = None
            self._motion.set_calibration(None)
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
        # A table's variance is that of the whole reading, the calibration's share included.
        covariance = np.array(calibration.covariance) if table is None else None
        self._active = CalibrationSolver(
            calibration_id,
            calibration,
            None if table is None else table_id,
            PointSolver(calibration.models, covariance, table, self._compute_device, threads=1),
            table,
            Predictor.of(calibration.models, covariance, table),
        )
        self._motion.set_calibration(self._active)

    def set_tracking_config(self, tracked: TrackingConfig) -> None:
        """Switch what is followed, between two batches; what cannot be followed says why."""
        self._motion.set_tracking_config(tracked)

    @property
    def is_tracking(self) -> bool:
        """Whether markers or tools are followed."""
        return self._motion.is_enabled

    @property
    def tracking_s(self) -> float:
        """How long markers and tools were followed in the newest batch [s]."""
        return self._tracking_s

    def process(
        self, frames: Sequence[LineFrame], *, track: Sequence[bool] | None = None
    ) -> FrameBatch:
        """Find the peaks of up to MAX_FRAMES frames and reconstruct their points.

        A device whose lines nothing is known to read gives neither. Without ``follow`` markers and
        tools are not looked for in these frames, and the poses say so.
        """
        if len(frames) == 1:
            lines = frames[0].lines
        else:
            lines = np.concatenate([frame.lines for frame in frames])
        return self.process_peaks(frames, self._finding.find(lines), track=track)

    def process_peaks(
        self,
        frames: Sequence[LineFrame],
        peaks: PeakBatch,
        *,
        track: Sequence[bool] | None = None,
    ) -> FrameBatch:
        """Do the rest for frames whose peaks are found; their lines are not looked at."""
        active = self._active
        usable = None
        if active is None or not self._finding.reads:
            points, owner = no_points(len(self._names)), np.empty(0, dtype=np.intp)
        else:
            usable = usable_peaks(active, frames, peaks, self._finding.use)
            points, owner = points_of(active, frames, usable)
        motion = None
        begin = time.perf_counter()
        if self._motion.is_enabled:
            motion = self._motion.find(frames, usable, points, owner, track)
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
