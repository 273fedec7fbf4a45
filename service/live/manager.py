"""LiveManager: owns every running device's threads; what the REST layer talks to."""

import logging
from dataclasses import dataclass
from threading import RLock
from typing import Literal

from compute.calibration.result import Calibration
from hardware.driver import DeviceDescription, Driver
from service.live.compute_thread import ComputeThread
from service.live.hub import Hub
from service.live.messages import status_message
from service.live.processor import MAX_FRAMES, DeviceProcessor
from service.live.reader import Reader
from service.live.ring import FrameRing

_log = logging.getLogger(__name__)

DeviceState = Literal["stopped", "running", "ended", "failed"]

RING_SECONDS = 2.0
RING_LEAST = 256


@dataclass(frozen=True)
class DeviceStatus:
    """What a device is doing, and what was lost where since it was started.

    Args:
        state: running, stopped by request, ended by itself (a recording), or failed.
        reason: why it failed, or ended; None otherwise.
        calibration_id: the calibration that points are reconstructed with; None: peaks only.
        frames: frames received from the driver.
        frames_lost_device: exposures missing in the device's sequence numbers.
        frames_dropped_ring: frames dropped because the compute thread did not keep up.
        frames_processed: frames that were published.
        subscribers: connected streams.
    """

    state: DeviceState
    reason: str | None = None
    calibration_id: str | None = None
    frames: int = 0
    frames_lost_device: int = 0
    frames_dropped_ring: int = 0
    frames_processed: int = 0
    subscribers: int = 0


class _Session:
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
        self.processed = 0
        self.failure: str | None = None

    def work(self) -> bool:
        """Process and publish what waits; runs in the compute thread."""
        frames = self.ring.take(MAX_FRAMES)
        if not frames or self.failure is not None:
            return False
        try:
            self.hub.publish_batch(self.processor.process(frames))
        except Exception as error:  # noqa: BLE001 - becomes the status
            _log.exception("device %s: processing failed", self.device_id)
            self.failure = f"processing failed: {type(error).__name__}: {error}"
            self.hub.publish(self.device_id, status_message(self.device_id, "failed", self.failure))
            return False
        self.processed += len(frames)
        return True

    def status(self) -> DeviceStatus:
        assert self.reader is not None
        return DeviceStatus(
            "failed" if self.failure else self.reader.state,
            self.failure or self.reader.reason,
            self.processor.calibration_id,
            self.ring.received,
            self.ring.lost,
            self.ring.dropped,
            self.processed,
            self.hub.subscribers(self.device_id),
        )


class LiveManager:
    """Starts and stops devices; all methods may be called from any thread."""

    def __init__(self, compute_device: str | None = None) -> None:
        """Start the compute thread; ``compute_device`` is "cpu", "cuda:0" or None for the best."""
        self.hub = Hub()
        self._compute_device = compute_device
        self._compute = ComputeThread()
        self._compute.start()
        self._sessions: dict[str, _Session] = {}
        self._lock = RLock()

    @property
    def ready(self) -> bool:
        """Whether the compute thread runs."""
        return self._compute.alive

    def start_device(
        self,
        device_id: str,
        driver: Driver,
        calibration_id: str | None = None,
        calibration: Calibration | None = None,
    ) -> DeviceDescription:
        """Open the driver and start its reader; raises LumilineError when it cannot be opened.

        A device that is running is stopped first. The first start in a process takes the time
        to load the kernels.
        """
        with self._lock:
            self.stop_device(device_id)
            driver.open()
            try:
                description = driver.description
                session = self._compute.submit(lambda: self._prepare(device_id, description))
                ready = session.result()
                ready.processor.set_calibration(calibration_id, calibration)
            except BaseException:
                driver.close()
                raise
            self._compute.submit(lambda: self._compute.add(device_id, ready.work)).result()
            ready.reader = Reader(device_id, driver, ready.ring, lambda: self._ended(ready))
            self._sessions[device_id] = ready
            self.hub.publish(device_id, status_message(device_id, "running", None))
            ready.reader.start()
            return description

    def stop_device(self, device_id: str) -> None:
        """Stop the device and close its driver; nothing happens when it is not running."""
        with self._lock:
            session = self._sessions.get(device_id)
            if session is None or session.reader is None:
                return
            was = session.reader.state
            session.reader.stop()
            # Behind the last batch in hand, so that nothing of it is published after this.
            self._compute.submit(lambda: self._compute.remove(device_id)).result()
            if was == "running":
                self.hub.publish(device_id, status_message(device_id, "stopped", None))

    def forget_device(self, device_id: str) -> None:
        """Stop the device and drop its counters."""
        with self._lock:
            self.stop_device(device_id)
            self._sessions.pop(device_id, None)

    def set_calibration(
        self, device_id: str, calibration_id: str | None, calibration: Calibration | None
    ) -> None:
        """Switch the calibration between two frames; nothing happens when it is not running."""
        with self._lock:
            session = self._sessions.get(device_id)
            if session is not None:
                session.processor.set_calibration(calibration_id, calibration)

    def status(self, device_id: str) -> DeviceStatus:
        """Return the device's status; "stopped" for one never started."""
        with self._lock:
            session = self._sessions.get(device_id)
            if session is None:
                return DeviceStatus("stopped", subscribers=self.hub.subscribers(device_id))
            return session.status()

    def describe(self, device_id: str) -> DeviceDescription | None:
        """Return what the device's driver says it is; None for one never started."""
        with self._lock:
            session = self._sessions.get(device_id)
            return session.description if session else None

    def close(self) -> None:
        """Stop all devices and the compute thread."""
        with self._lock:
            for device_id in list(self._sessions):
                self.stop_device(device_id)
            self._compute.close()

    def _prepare(self, device_id: str, description: DeviceDescription) -> _Session:
        """Make the device's buffers; runs in the compute thread."""
        capacity = max(RING_LEAST, int(RING_SECONDS * description.frame_rate_hz))
        ring = FrameRing(capacity, self._compute.wake)
        processor = DeviceProcessor(device_id, description, self._compute_device)
        return _Session(device_id, description, processor, ring, self.hub)

    def _ended(self, session: _Session) -> None:
        """Tell the clients that a device ended by itself, behind its last frames."""
        reader = session.reader
        assert reader is not None

        def tell() -> None:
            while session.work():
                pass
            self.hub.publish(
                session.device_id,
                status_message(session.device_id, reader.state, reader.reason),
            )

        self._compute.submit(tell)
