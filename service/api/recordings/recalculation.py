"""Points of recorded frames by another calibration, worked out in a process of its own."""

from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from hardware.driver import DeviceDescription
from service.api.concurrency_limit import ConcurrencyLimit
from service.api.devices.schema import check_sensors
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
    """Works points out from recorded peaks, as the live pipeline would with another calibration.

    In a process: frames with many markers lit together take long, and would keep the live pipeline
    waiting. It is started when needed, keeps its kernels, and ends when idle.
    """

    def __init__(self) -> None:
        self._process = CallProcess(MEMORY_BYTES, PEAK_BYTES)
        self._limit = ConcurrencyLimit(
            MAX_CONCURRENT,
            f"{MAX_CONCURRENT} requests wait for points by another calibration; send this one "
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


@lru_cache(maxsize=MAX_DEVICES)
def _processor(description: DeviceDescription) -> FrameProcessor:
    return FrameProcessor("recording", description, "cpu")
