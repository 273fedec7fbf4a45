"""Results of recorded frames, worked out in a process of its own: points, captured targets."""

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from hardware.driver import DeviceDescription
from service.api.captures.schema import CapturedTarget, CaptureSettings, NewCapture, Target
from service.api.concurrency_limit import ConcurrencyLimit
from service.api.devices.schema import Sensor, check_sensors
from service.api.recordings.playback import recorded_frames
from service.jobs.call_process import CallProcess
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.frame_processor import MAX_FRAMES, FrameProcessor

if TYPE_CHECKING:
    from hardware.recording.frame_block import FrameBlock

TIMEOUT_S: Final = 60.0
"""For a request; the first one starts the process and loads its kernels, in seconds."""
MEMORY_BYTES: Final = 4 * 2**30
PEAK_BYTES: Final = 2**30
MAX_CONCURRENT: Final = 4
MAX_DEVICES: Final = 2
"""Devices whose kernels the process keeps."""


class Recalculation:
    """Works results out from recordings, as the live pipeline would have.

    Points with another calibration, and captures of targets. In a process: frames with many markers
    lit together take long, and would keep the live pipeline waiting. It is started when needed,
    keeps its kernels, and ends when idle.
    """

    def __init__(self) -> None:
        self._process = CallProcess(MEMORY_BYTES, PEAK_BYTES)
        self._limit = ConcurrencyLimit(
            MAX_CONCURRENT,
            f"{MAX_CONCURRENT} requests wait for results of recordings; send this one "
            "again in a second",
        )

    def frames(
        self, path: Path, name: str, first: int, count: int, given: ActiveCalibration
    ) -> str:
        """Return RecordedFrames as JSON; the arguments are those of ``recorded_frames``.

        Args:
            path: the file.
            name: the recording.
            first: number of the first frame.
            count: how many, at most.
            given: the calibration, without its content.

        Raises:
            Busy: too many such requests wait.
            SensorsChanged: the calibration is of other sensors than the recording.
            InvalidRecording: as ``recorded_frames``.
            WorkerEnded: it took too much time or memory.
        """
        with self._limit:
            found: str = self._process.call(
                _frames, path, name, first, count, given, timeout_s=TIMEOUT_S
            )
        return found

    def captured(
        self, path: Path, request: NewCapture, sensors: Sequence[Sensor]
    ) -> list[CapturedTarget]:
        """Return what a recording has of a capture session's targets.

        Args:
            path: the recording.
            request: the session to begin.
            sensors: of its device.

        Raises:
            Busy: too many such requests wait.
            WorkerEnded: it took too much time or memory.
            LumilineError: as ``captured_targets``.
        """
        with self._limit:
            found: list[CapturedTarget] = self._process.call(
                _captured, path, request.device_id, list(sensors), request.targets,
                request.settings, timeout_s=TIMEOUT_S,
            )  # fmt: skip
        return found

    def close(self) -> None:
        """End the process."""
        self._process.close()


def _frames(path: Path, name: str, first: int, count: int, given: ActiveCalibration) -> str:
    # The file library is loaded by the process alone.
    from service.api.recordings.recorded_peaks import process_block
    from service.api.recordings.result_rows import point_rows

    def solve(block: "FrameBlock", description: DeviceDescription) -> NDArray[np.void]:
        assert given.calibration is not None
        check_sensors(description.name, description.sensors, given.calibration.models)
        processor = _processor(description)
        processor.set_calibration(given)
        rows = []
        for start in range(0, len(block.rows), MAX_FRAMES):
            numbers = np.arange(len(block.rows))
            part = block.select((numbers >= start) & (numbers < start + MAX_FRAMES))
            made, _ = point_rows(process_block(part, processor, description))
            made["frame"] += start
            rows.append(made)
        return np.concatenate(rows)

    found = recorded_frames(path, name, first, count, given.calibration_id, solve)
    return found.model_dump_json()


def _captured(
    path: Path, device_id: str, sensors: list[Sensor], targets: list[Target],
    settings: CaptureSettings,
) -> list[CapturedTarget]:  # fmt: skip
    # The file library is loaded by the process alone.
    from service.api.recordings.recorded_readings import captured_targets

    return captured_targets(path, device_id, sensors, targets, settings)


@lru_cache(maxsize=MAX_DEVICES)
def _processor(description: DeviceDescription) -> FrameProcessor:
    return FrameProcessor("recording", description, "cpu")
