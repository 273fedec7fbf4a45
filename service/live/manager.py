"""LiveManager: owns every running device's threads; what the REST layer talks to."""

import logging
import time
from dataclasses import dataclass
from threading import RLock
from typing import Literal

from compute.calibration.result import Calibration
from compute.errors import InvalidParameter, LumilineError
from hardware.driver import DeviceDescription, Driver
from service.live.compute_thread import ComputeThread
from service.live.hub import Hub
from service.live.messages import describe_message, status_message
from service.live.processor import MAX_FRAMES, DeviceProcessor
from service.live.reader import Reader
from service.live.ring import FrameRing

_log = logging.getLogger(__name__)

DeviceState = Literal["stopped", "running", "ended", "failed"]

BATCH_SECONDS = 0.02
"""How long the frames of one device may keep those of the others waiting."""
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
            self.hub.publish_batch(self.processor.process(frames))
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
        # Read without the lock, which may be held while a driver is opened or closed.
        self._sessions: dict[str, _Session] = {}
        self._refused: dict[str, str] = {}
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

        A device that is running is stopped first. One that cannot be started is "failed", with
        the reason. The first start in a process takes the time to load the kernels.
        """
        with self._lock:
            self.stop_device(device_id)
            try:
                session = self._open(device_id, driver, calibration_id, calibration)
            except LumilineError as error:
                self._sessions.pop(device_id, None)
                self._refused[device_id] = error.detail
                self.hub.publish(device_id, status_message(device_id, "failed", error.detail))
                raise
            self._refused.pop(device_id, None)
            session.reader = Reader(device_id, driver, session.ring, lambda: self._ended(session))
            self._compute.submit(lambda: self._compute.add(device_id, session.work)).result()
            self._sessions[device_id] = session
            status = status_message(device_id, "running", None)
            self.hub.publish(device_id, status | describe_message(session.description))
            session.reader.start()
            return session.description

    def _open(
        self,
        device_id: str,
        driver: Driver,
        calibration_id: str | None,
        calibration: Calibration | None,
    ) -> _Session:
        """Open the driver and make the buffers; on an error the driver is closed again."""
        driver.open()
        try:
            description = driver.description
            session = self._compute.submit(lambda: self._prepare(device_id, description)).result()
            session.processor.set_calibration(calibration_id, calibration)
        except BaseException:
            driver.close()
            raise
        return session

    def stop_device(self, device_id: str) -> None:
        """Stop the device and close its driver; nothing happens when it is not running."""
        with self._lock:
            session = self._sessions.get(device_id)
            if session is None or session.reader is None or session.stopped:
                return
            was_running = session.running
            session.reader.stop()
            session.stopped = True
            # Behind the last batch in hand, so that nothing of it is published after this.
            self._compute.submit(lambda: self._compute.remove(device_id)).result()
            if was_running:
                self.hub.publish(device_id, status_message(device_id, "stopped", None))

    def forget_device(self, device_id: str) -> None:
        """Stop the device, drop its counters and end its streams: it is deleted."""
        with self._lock:
            self.stop_device(device_id)
            self._sessions.pop(device_id, None)
            self._refused.pop(device_id, None)
            self.hub.end(device_id, status_message(device_id, "deleted", None))

    def set_calibration(
        self, device_id: str, calibration_id: str | None, calibration: Calibration | None
    ) -> None:
        """Switch the calibration between two frames; nothing happens when it is not running.

        Nor when the device runs with other sensors than the calibration's: its source was
        changed meanwhile, and sensors and calibration work together from the next start.
        """
        with self._lock:
            session = self._sessions.get(device_id)
            if session is None or not session.running:
                return
            try:
                session.processor.set_calibration(calibration_id, calibration)
            except InvalidParameter as error:
                _log.warning("device %s goes on as it was: %s", device_id, error.detail)

    def status(self, device_id: str) -> DeviceStatus:
        """Return the device's status; "stopped" for one never started. Never waits."""
        session = self._sessions.get(device_id)
        if session is not None:
            return session.status()
        reason = self._refused.get(device_id)
        return DeviceStatus(
            "failed" if reason else "stopped", reason, subscribers=self.hub.subscribers(device_id)
        )

    def describe(self, device_id: str) -> DeviceDescription | None:
        """Return what the device's driver says it is; None for one never started. Never waits."""
        session = self._sessions.get(device_id)
        return session.description if session else None

    def close(self) -> None:
        """Stop all devices and the compute thread."""
        with self._lock:
            readers = [s.reader for s in self._sessions.values() if s.reader is not None]
            for reader in readers:
                reader.close_driver()
            self._compute.close()
            for reader in readers:
                reader.stop()

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
