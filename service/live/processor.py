"""Frames of one device to peaks and points, with the calibration in force."""

from collections.abc import Sequence

import numpy as np

from compute.calibration.result import Calibration
from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from hardware.driver import DeviceDescription
from hardware.frame import LineFrame
from service.live.batch import FrameBatch
from service.live.frame_points import ActiveCalibration, frame_points, no_points
from service.live.line_model import LineModel, line_model
from service.live.peak_finding import PeakFinding

MAX_FRAMES = 64
"""Frames that are processed together, at most, when they have piled up."""


class DeviceProcessor:
    """Pure function of frames and calibration, with the buffers that it needs.

    Made and called in the compute thread; ``set_calibration`` may be called from any thread and
    takes effect between two batches.
    """

    def __init__(
        self,
        device_id: str,
        description: DeviceDescription,
        compute_device: str | None = None,
        model: LineModel | None = None,
    ) -> None:
        """Load what finds the peaks; ``compute_device`` as of FitFinder.

        Without a model, it is that of the built-in profile that the description names.
        """
        self._device_id = device_id
        self._names = tuple(sensor.name for sensor in description.sensors)
        self._active: ActiveCalibration | None = None
        model = line_model(description) if model is None else model
        self._finding = PeakFinding(description, MAX_FRAMES, model, compute_device)

    @property
    def calibration_id(self) -> str | None:
        """The calibration in force."""
        active = self._active
        return active.calibration_id if active else None

    def set_calibration(self, calibration_id: str | None, calibration: Calibration | None) -> None:
        """Switch the calibration; one assignment, so that a batch sees the old or the new.

        Raises:
            InvalidParameter: the calibration is of other sensors.
        """
        if calibration_id is None or calibration is None:
            self._active = None
            return
        names = tuple(model.name for model in calibration.models)
        if names != self._names:
            raise InvalidParameter(
                f"calibration {calibration_id} is of the sensors {', '.join(names)}; the device "
                f"has {', '.join(self._names)}"
            )
        self._active = ActiveCalibration(
            calibration_id,
            calibration,
            CameraStack.of(calibration.models),
            np.array(calibration.covariance),
        )

    def process(self, frames: Sequence[LineFrame]) -> FrameBatch:
        """Find the peaks of up to MAX_FRAMES frames and reconstruct their points.

        A device whose lines nothing is known to read gives neither.
        """
        active = self._active
        if len(frames) == 1:
            lines = frames[0].lines
        else:
            lines = np.concatenate([frame.lines for frame in frames])
        peaks = self._finding.find(lines)
        if active is None or not self._finding.reads:
            points, owner = no_points(len(self._names)), np.empty(0, dtype=np.intp)
        else:
            points, owner = frame_points(active, frames, peaks, self._finding.use)
        return FrameBatch(
            self._device_id,
            self._names,
            active.calibration_id if active else None,
            tuple(frames),
            peaks,
            points,
            owner,
        )
