"""FrameTap: collects the scans of a running device's next frames, for their statistics."""

from collections import deque
from threading import Event
from typing import TYPE_CHECKING, Final

from service.api.radiometric_calibrations.frame_statistics import FrameAccumulator
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.frame_batch import FrameBatch

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


class FrameTap:
    """Hands the scans of frames from the compute thread to the one that sums them up.

    Args:
        after_sequence: frames after this sequence number count.
        frames: how many.
        sensors: of the device.
    """

    wants_pixels: Final = True

    def __init__(self, after_sequence: int, frames: int, sensors: int) -> None:
        self._after = after_sequence
        self._left = frames
        self._waiting: deque[NDArray[np.uint16]] = deque()
        self.sums = FrameAccumulator(sensors)
        self.ended = Event()
        """Set when all frames have come."""

    def prepare(self, found: ActiveCalibration) -> None:
        """Do nothing: scans do not depend on it."""

    def offer(self, batch: FrameBatch) -> None:
        """Take the scans of a batch; called where frames are processed, never waits."""
        for frame in batch.frames:
            if self._left and frame.sequence > self._after:
                self._waiting.append(frame.lines)
                self._left -= 1
        if not self._left:
            self.ended.set()

    def add_up(self) -> bool:
        """Add the frames that wait to the sums; called in the thread that waits for them."""
        while self._waiting:
            self.sums.add(self._waiting.popleft())
        return False
