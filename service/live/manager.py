"""LiveManager: owns every running device's threads; what the REST layer talks to."""

import logging
import time
from threading import Lock, RLock

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter, LumilineError
from hardware.driver import DeviceDescription, Driver
from service.errors import DeviceNotRunning
from service.live.compute_thread import ComputeThread
from service.live.hub import Hub
from service.live.in_force import NOTHING, InForce
from service.live.line_model import FindProfile, LineModel, built_in_profile, line_model
from service.live.messages import describe_message, status_message
from service.live.processor import DeviceProcessor
from service.live.reader import Reader
from service.live.ring import FrameRing
from service.live.session import DeviceSession, DeviceStatus
from service.live.tap import PeakTap

_log = logging.getLogger(__name__)

RING_SECONDS = 2.0
RING_LEAST = 256
_LOOK_S = 0.1


class LiveManager:
    """Starts and stops devices; all methods may be called from any thread."""

    def __init__(
        self, compute_device: str | None = None, find_profile: FindProfile = built_in_profile
    ) -> None:
        """Start the compute thread; ``compute_device`` is "cpu", "cuda:0" or None for the best.

        ``find_profile`` returns the device profiles that descriptions name.
        """
        self.hub = Hub()
        self._compute_device = compute_device
        self._find_profile = find_profile
        self._compute = ComputeThread()
        self._compute.start()
        # Read without the lock, which may be held while a driver is opened or closed.
        self._sessions: dict[str, DeviceSession] = {}
        self._refused: dict[str, str] = {}
        self._lock = RLock()
        self._taps_lock = Lock()

    @property
    def ready(self) -> bool:
        """Whether the compute thread runs."""
        return self._compute.alive

    def start_device(
        self,
        device_id: str,
        driver: Driver,
        found: InForce = NOTHING,
    ) -> DeviceDescription:
        """Open the driver and start its reader; raises LumilineError when it cannot be opened.

        A device that is running is stopped first. One that cannot be started is "failed", with
        the reason. The first start in a process takes the time to load the kernels.
        """
        with self._lock:
            self.stop_device(device_id)
            try:
                session = self._open(device_id, driver, found)
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
        found: InForce,
    ) -> DeviceSession:
        """Open the driver and make the buffers; on an error the driver is closed again."""
        driver.open()
        try:
            description = driver.description
            # Here and not in the compute thread: it takes tenths of a second.
            model = line_model(description, self._find_profile)
            session = self._compute.submit(
                lambda: self._prepare(device_id, description, model)
            ).result()
            self._set(session, found)
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

    def set_calibration(self, device_id: str, found: InForce) -> None:
        """Switch calibration and table between two frames; nothing happens when it is not running.

        Nor when the device runs with other sensors than the calibration's: its source was
        changed meanwhile, and sensors and calibration work together from the next start.
        """
        with self._lock:
            session = self._sessions.get(device_id)
            if session is None or not session.running:
                return
            try:
                self._set(session, found)
            except InvalidParameter as error:
                _log.warning("device %s goes on as it was: %s", device_id, error.detail)

    def _set(self, session: DeviceSession, found: InForce) -> None:
        """Hand calibration and table to the processor, between two batches in its own thread."""
        given = found.calibration_id, found.calibration, found.table_id, found.table
        self._compute.submit(lambda: session.processor.set_calibration(*given)).result()

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

    def collect(
        self, device_id: str, frames: int, marker: int | None, timeout_s: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return what the sensors read of one marker in the next frames of a running device.

        Args:
            device_id: the device.
            frames: how many.
            marker: the strobed marker; None: frames in which all are lit, and one is in view.
            timeout_s: how long they are waited for; then there are fewer.

        Returns:
            Positions and their deviations [px], shape (F, S); NaN where a sensor saw no clear
            peak.

        Raises:
            DeviceNotRunning: it does not run, or ends meanwhile.
        """
        session = self._sessions.get(device_id)
        if session is None or not session.running:
            raise _not_running(device_id)
        tap = PeakTap(session.ring.last_sequence, frames, marker)
        end = time.monotonic() + timeout_s
        with self._taps_lock:
            session.taps = (*session.taps, tap)
        try:
            while not tap.wait(max(0.0, min(_LOOK_S, end - time.monotonic()))):
                if not session.running:
                    raise _not_running(device_id)
                if time.monotonic() >= end:
                    break
        finally:
            with self._taps_lock:
                session.taps = tuple(one for one in session.taps if one is not tap)
        return tap.readings(len(session.description.sensors))

    def close(self) -> None:
        """Stop all devices and the compute thread."""
        with self._lock:
            readers = [s.reader for s in self._sessions.values() if s.reader is not None]
            for reader in readers:
                reader.close_driver()
            self._compute.close()
            for reader in readers:
                reader.stop()

    def _prepare(
        self, device_id: str, description: DeviceDescription, model: LineModel
    ) -> DeviceSession:
        """Make the device's buffers; runs in the compute thread."""
        capacity = max(RING_LEAST, int(RING_SECONDS * description.frame_rate_hz))
        ring = FrameRing(capacity, self._compute.wake)
        processor = DeviceProcessor(device_id, description, self._compute_device, model)
        return DeviceSession(device_id, description, processor, ring, self.hub)

    def _ended(self, session: DeviceSession) -> None:
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


def _not_running(device_id: str) -> DeviceNotRunning:
    return DeviceNotRunning(
        f'device "{device_id}" does not run; start it to capture what it sees', device=device_id
    )
