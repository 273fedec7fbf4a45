"""Results of recorded frames, worked out in a process of its own: points, tracks, tool poses."""

import pickle
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

from service.api.devices.schema import check_sensors
from service.api.recordings.playback import FrameResults, recorded_frames
from service.api.recordings.recording_process import RecordingProcess
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.tracking_config import NO_TRACKING, TrackingConfig

if TYPE_CHECKING:
    from hardware.recording.reader import RecordingReader
    from service.api.recordings.recording_pipeline import RecordingPipelines
    from service.pipeline.detection_stage import FindProfile

MAX_PIPELINES: Final = 4
"""Positions in recordings, each with a calibration, at which the process can continue."""


class Recalculation:
    """Works results out from recordings, as the live pipeline would have.

    Points with another calibration, tracks and tool poses.

    Args:
        find_profile: returns the device profiles that descriptions name; can be pickled.
    """

    def __init__(self, find_profile: "FindProfile") -> None:
        self._find_profile = find_profile
        self._process = RecordingProcess("results")

    def frames(
        self,
        path: Path,
        name: str,
        first: int,
        count: int,
        calibration: ActiveCalibration | None,
        tracking: TrackingConfig = NO_TRACKING,
    ) -> str:
        """Return RecordedFrames as JSON; the arguments are those of ``recorded_frames``.

        Args:
            path: the file.
            name: the recording.
            first: number of the first frame.
            count: how many, at most.
            calibration: without its content; None: those of the recording.
            tracking: markers and tools to track.

        Raises:
            Busy: too many such requests wait.
            SensorsChanged: the calibration is of other sensors than the recording.
            InvalidRecording: as ``recorded_frames``.
            InvalidParameter: a calibration in the recording is of other sensors.
            WorkerEnded: it took too much time or memory.
        """
        # Pickled here, so that equal configurations are the same bytes there.
        config = pickle.dumps((calibration, tracking))
        document: str = self._process.call(
            _frames, path, name, first, count, config, self._find_profile
        )
        return document

    def close(self) -> None:
        """End the process."""
        self._process.close()


def _frames(
    path: Path,
    name: str,
    first: int,
    count: int,
    config: bytes,
    find_profile: "FindProfile",
) -> str:
    calibration: ActiveCalibration | None
    tracking: TrackingConfig
    calibration, tracking = pickle.loads(config)  # noqa: S301 - from the server itself

    def recalculate(reader: "RecordingReader", first: int, end: int) -> list[FrameResults]:
        description = reader.info.description
        if calibration is not None:
            assert calibration.calibration is not None
            check_sensors(description.name, description.sensors, calibration.calibration.models)
        # File systems use the inode of a deleted file again.
        key = (path, path.stat().st_ino, reader.fingerprint(), config)
        return _pipelines().results(key, reader, first, end, calibration, tracking, find_profile)

    calibration_id = None if calibration is None else calibration.calibration_id
    return recorded_frames(path, name, first, count, calibration_id, recalculate).model_dump_json()


@cache
def _pipelines() -> "RecordingPipelines":
    """Return the pipelines of the process."""
    # The file library is loaded by the process alone.
    from service.api.recordings.recording_pipeline import RecordingPipelines

    return RecordingPipelines(MAX_PIPELINES)
