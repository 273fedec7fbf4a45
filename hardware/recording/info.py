"""RecordingInfo: what a recording holds."""

from dataclasses import dataclass
from typing import Any

from hardware.driver import DeviceDescription
from hardware.recording.layout import RecordingState


@dataclass(frozen=True)
class RecordingInfo:
    """What a recording holds.

    Args:
        description: the device that it is of.
        frames: number of frames.
        duration_s: from the first exposure to the last, on the device's clock [s].
        lost: exposures missing between the first frame and the last.
        complete: whether the writer closed it; False while it is written, and after a crash.
        version: of the layout.
        lines: whether it holds lines.
        results: whether it holds peaks and points.
        provenance: what the writer said of how it was made; empty in version 1.
        state: what was lost where, and why it ended; of version 1 it is little.
    """

    description: DeviceDescription
    frames: int
    duration_s: float
    lost: int
    complete: bool
    version: int
    lines: bool
    results: bool
    provenance: dict[str, Any]
    state: RecordingState
