"""TargetExtraction: captured targets of recordings, worked out in a process of its own."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from service.api.captures.schema import CapturedTarget, CaptureSettings, NewCapture, Target
from service.api.devices.schema import Sensor
from service.api.recordings.recording_process import RecordingProcess

if TYPE_CHECKING:
    from service.pipeline.detection_stage import FindProfile


class TargetExtraction:
    """Extracts what recordings have of the targets of capture sessions.

    Not in the process of the players, who would keep a capture waiting.

    Args:
        find_profile: returns the device profiles that descriptions name; can be pickled.
    """

    def __init__(self, find_profile: "FindProfile") -> None:
        self._find_profile = find_profile
        self._process = RecordingProcess("targets")

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
        targets: list[CapturedTarget] = self._process.call(
            _captured, path, request.device_id, list(sensors), request.targets,
            request.settings, self._find_profile,
        )  # fmt: skip
        return targets

    def close(self) -> None:
        """End the process."""
        self._process.close()


def _captured(
    path: Path, device_id: str, sensors: list[Sensor], targets: list[Target],
    settings: CaptureSettings, find_profile: "FindProfile",
) -> list[CapturedTarget]:  # fmt: skip
    # The file library is loaded by the process alone.
    from service.api.recordings.recorded_readings import captured_targets

    return captured_targets(path, device_id, sensors, targets, settings, find_profile)
