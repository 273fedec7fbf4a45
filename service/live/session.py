"""DeviceSession: one device from start to stop, what it does and what it has lost."""

import logging
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from hardware.driver import DeviceDescription
from service.live.hub import Hub
from service.live.messages import status_message
from service.live.processor import MAX_FRAMES, DeviceProcessor
from service.live.ring import FrameRing

if TYPE_CHECKING:
    from service.live.reader import Reader
    from service.live.tap import PeakTap

_log = logging.getLogger(__name__)

DeviceState = Literal["stopped", "running", "ended", "failed"]

BATCH_SECONDS = 0.02
"""How long the frames of one device may keep those of the others waiting."""


@dataclass(frozen=True)
class DeviceStatus:
    """What a device is doing, and what was lost where since it was started.

    Args:
        state: running, stopped by request, ended by itself (a recording), or failed.
        reason: why it failed, or ended; None otherwise.
        calibration_id: the calibration that points are reconstructed with; None: peaks only.
        table_id: the correction table that readings are corrected by; None: they are not.
        frames: frames received from the driver.
        frames_lost_device: exposures missing in the device's sequence numbers.
        frames_dropped_ring: frames dropped because the compute thread did not keep up.
        frames_processed: frames that were published.
        subscribers: connected streams.
    """

    state: DeviceState
    reason: str | None = None
    calibration_id: str | None = None
    table_id: str | None = None
    frames: int = 0
    frames_lost_device: int = 0
    frames_dropped_ring: int = 0
    frames_processed: int = 0
    subscribers: int = 0


class DeviceSession:
    """One device from start to stop."""

    def __init__(
        self,
        device_id: str,
        description: DeviceDescription,
        processor: DeviceProcessor,
        ring: FrameRing,
        hub: Hub,
    ) -> None:
        self.device_id = device_id
        self.description = description
        self.processor = processor
        self.ring = ring
        self.hub = hub
        self.reader: Reader | None = None
        self.taps: tuple[PeakTap, ...] = ()
        """Who takes readings beside the streams; replaced as a whole, so that it may be read."""
        self.processed = 0
        self.failure: str | None = None
        self.stopped = False
        self._batch = MAX_FRAMES

    def work(self) -> bool:
        """Process and publish what waits; runs in the compute thread."""
        if self.failure is not None:
            return False
        frames = self.ring.take(self._batch)
        if not frames:
            return False
        begin = time.monotonic()
        try:
            batch = self.processor.process(frames)
            for tap in self.taps:
                tap.offer(batch)
            self.hub.publish_batch(batch)
        except Exception as error:  # noqa: BLE001 - becomes the status
            self._fail(error)
            return False
        self.processed += len(frames)
        # Other devices wait meanwhile: a device whose frames take long gets short batches.
        per_frame = (time.monotonic() - begin) / len(frames)
        self._batch = max(1, min(MAX_FRAMES, int(BATCH_SECONDS / max(per_frame, 1e-6))))
        return True

    def _fail(self, error: Exception) -> None:
        """Give the device up: its driver is closed, clients are told, the log has the cause."""
        _log.error("device %s: processing failed", self.device_id, exc_info=error)
        self.failure = f"processing failed: {type(error).__name__}: {error}"
        if self.reader is not None:
            self.reader.close_driver()
        self.hub.publish(self.device_id, status_message(self.device_id, "failed", self.failure))

    @property
    def running(self) -> bool:
        """Whether frames still come."""
        return self.failure is None and self.reader is not None and self.reader.state == "running"

    def status(self) -> DeviceStatus:
        """Return how things stand."""
        assert self.reader is not None
        return DeviceStatus(
            "failed" if self.failure else self.reader.state,
            self.failure or self.reader.reason,
            self.processor.calibration_id,
            self.processor.table_id,
            self.ring.received,
            self.ring.lost,
            self.ring.dropped,
            self.processed,
            self.hub.subscribers(self.device_id),
        )
