"""PipelineManager: starts and stops devices and their threads; the API's door to the pipeline."""

import logging
from functools import partial
from threading import RLock

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from hardware.driver import DeviceDescription, Driver
from hardware.link import LinkedDriver, LinkState
from service.pipeline.active_calibration import NO_ACTIVE_CALIBRATION, ActiveCalibration
from service.pipeline.beam_hold_registry import BeamHoldRegistry, BeamHoldWatchdog
from service.pipeline.detection_stage import (
    ExpectedScans,
    FindProfile,
    built_in_profile,
    expected_scans,
)
from service.pipeline.device_connector import DeviceConnector
from service.pipeline.device_session import (
    DeviceSession,
    StreamPublisher,
    ToolCounts,
)
from service.pipeline.device_status import DeviceStatus
from service.pipeline.frame_batch import LatestPoses
from service.pipeline.frame_processor import FrameProcessor
from service.pipeline.interface import Accept, DeviceUser, StationState, any_device
from service.pipeline.stage_latency import Stage
from service.pipeline.tap_collection import collect_readings, not_running
from service.pipeline.threads import ComputeThread, FrameRing, ReaderThread
from service.pipeline.tracking_config import NO_TRACKING, TrackingConfig

_log = logging.getLogger(__name__)

RING_SECONDS = 2.0
MIN_RING_FRAMES = 256
FIRST_ATTEMPT_S = 3.0
"""How long a start waits for a device that may not be there; then it goes on by itself."""
OPEN_S = 30.0
"""The same for all others: their drivers may hang, too."""
STOPPED = "the device is stopped"
NOT_AS_STORED = (
    "what is stored of it could not be taken over (the log says why); change the hold, or start "
    "the device again"
)


class PipelineManager:
    """Starts and stops devices; all methods may be called from any thread."""

    def __init__(
        self,
        streams: StreamPublisher,
        compute_device: str | None = None,
        find_profile: FindProfile = built_in_profile,
    ) -> None:
        """Start the compute thread.

        Args:
            streams: takes the results for the clients.
            compute_device: "cpu", "cuda:0", ...; None: the best there is.
            find_profile: returns the device profiles that descriptions name.
        """
        self.streams = streams
        self.poses = LatestPoses()
        """The newest poses of all tools."""
        self.holds = BeamHoldRegistry(streams.publish_hold)
        """Whether beams are held."""
        self._watchdog = BeamHoldWatchdog(self.holds)
        self._compute_device = compute_device
        self._find_profile = find_profile
        self._compute = ComputeThread()
        # Read without the lock, which may be held while a driver is opened or closed.
        self._sessions: dict[str, DeviceSession] = {}
        self._openings: dict[str, DeviceConnector] = {}
        self._refused: dict[str, str] = {}
        self._tracked: dict[str, TrackingConfig] = {}
        self._lock = RLock()

    @property
    def ready(self) -> bool:
        """Whether the compute thread runs."""
        return self._compute.alive

    @property
    def busy_s(self) -> float:
        """Time that the compute thread has spent on its current batch or job [s]."""
        return self._compute.busy_s

    @property
    def stations(self) -> tuple[StationState, ...]:
        """None: devices belong to this process."""
        return ()

    def start_device(
        self,
        device_id: str,
        driver: Driver,
        active: ActiveCalibration = NO_ACTIVE_CALIBRATION,
        accept: Accept = any_device,
    ) -> DeviceDescription | None:
        """Open the driver and start its reader; raises LumilineError when it cannot be opened.

        A device that is running is stopped first. One that cannot be started is "failed", with
        the reason. One that can be unplugged, and is, becomes "disconnected" and is tried again
        until it is there, or is stopped: then there is no description yet, nor where opening it
        takes longer than OPEN_S. ``accept`` checks the description before anything is made of it.
        The first start in a process takes the time to load the kernels.
        """
        if isinstance(driver, DeviceUser):
            driver.bind(self)
        previous = self._openings.get(device_id)
        with self._lock:
            self.stop_device(device_id)
            opening = DeviceConnector(
                device_id,
                driver,
                active,
                lambda opening: self._opened(device_id, opening, accept),
                lambda opening: self._opening_changed(device_id, opening),
            )
            self._refused.pop(device_id, None)
            self._openings[device_id] = opening
            self.streams.publish_status(device_id, "starting")
        # Not under the lock: other devices go on while this one's is waited for.
        if previous is not None:
            previous.join()
        opening.start(FIRST_ATTEMPT_S if isinstance(driver, LinkedDriver) else OPEN_S)
        session = self._sessions.get(device_id)
        return session.description if session is not None and session.running else None

    def _opened(self, device_id: str, opening: DeviceConnector, accept: Accept) -> None:
        """Make the buffers of a device whose driver is open, and start its reader.

        Raises:
            LumilineError: it is another device than it should be, or cannot be used.
        """
        driver = opening.driver
        description = driver.description
        accept(description)
        # Here and not in the compute thread: it takes tenths of a second.
        model = expected_scans(description, self._find_profile)
        with self._lock:
            if opening.cancelled.is_set():
                driver.close()
                return
            session = self._compute.submit(
                lambda: self._prepare(device_id, description, model)
            ).result()
            tracked = self._tracked.get(device_id, NO_TRACKING)
            if tracked is not NO_TRACKING:
                self._compute.submit(lambda: session.set_tracking_config(tracked)).result()
            self._set(session, opening.active)
            session.reader = ReaderThread(
                device_id,
                driver,
                session.ring,
                partial(session.process_frame, self._compute),
                lambda: self._compute.submit(session.publish_change),
            )
            self._compute.submit(lambda: self._compute.add(device_id, session.work)).result()
            self._sessions[device_id] = session
            self._openings.pop(device_id, None)
            session.publish_status()
            session.reader.start()

    def _opening_changed(self, device_id: str, opening: DeviceConnector) -> None:
        """Publish that a device is waited for, or could not be opened."""
        with self._lock:
            if opening.cancelled.is_set():
                return
            if opening.state == "failed":
                self._refuse(device_id, opening.reason or "")
            else:
                self.streams.publish_status(device_id, opening.state, opening.reason, opening.state)

    def _refuse(self, device_id: str, reason: str) -> None:
        """Keep and publish why a device was not started."""
        self._openings.pop(device_id, None)
        self._sessions.pop(device_id, None)
        self._refused[device_id] = reason
        self.streams.publish_status(device_id, "failed", reason)

    def stop_device(self, device_id: str) -> None:
        """Stop the device and close its driver; nothing happens when it is not running."""
        with self._lock:
            opening = self._openings.pop(device_id, None)
            if opening is not None:
                opening.cancel()
                self.holds.fail(device_id, STOPPED)
                self.streams.publish_status(device_id, "stopped")
                return
            session = self._sessions.get(device_id)
            if session is None or session.reader is None or session.stopped:
                return
            was_running = session.running
            session.reader.stop()
            session.stopped = True
            # Behind the last batch in hand, so that nothing of it is published after this.
            self._compute.submit(lambda: self._compute.remove(device_id)).result()
            self.poses.remove(device_id)
            self.holds.fail(device_id, STOPPED)
            if was_running:
                self.streams.publish_status(device_id, "stopped")

    def forget_device(self, device_id: str) -> None:
        """Stop the device, drop its counters and end its streams: it is deleted."""
        with self._lock:
            self.stop_device(device_id)
            self._sessions.pop(device_id, None)
            self._refused.pop(device_id, None)
            self._tracked.pop(device_id, None)
            self.holds.forget(device_id)
            self.streams.end(device_id)

    def set_calibration(self, device_id: str, active: ActiveCalibration) -> None:
        """Switch calibration and table between two frames; nothing happens when it is not running.

        Nor when the device runs with other sensors than the calibration's: its source was
        changed meanwhile, and sensors and calibration work together from the next start.
        """
        with self._lock:
            opening = self._openings.get(device_id)
            if opening is not None:
                opening.active = active
            session = self._sessions.get(device_id)
            if session is None or not session.running:
                return
            try:
                self._set(session, active)
            except InvalidParameter as error:
                _log.warning("device %s goes on as it was: %s", device_id, error.detail)

    def set_tracking_config(self, device_id: str, tracked: TrackingConfig) -> None:
        """Set a device's tracking configuration: from the next batch on, or once it is started."""
        with self._lock:
            self._tracked[device_id] = tracked
            try:
                self.holds.set(device_id, tracked.holds)
                session = self._sessions.get(device_id)
                if session is not None and session.running:
                    self._compute.submit(lambda: session.set_tracking_config(tracked)).result()
            except Exception:
                self.holds.distrust(device_id, NOT_AS_STORED)
                raise

    def tracked(self, device_id: str) -> TrackingConfig:
        """Return a device's tracking configuration, now or once it is started."""
        return self._tracked.get(device_id, NO_TRACKING)

    def _set(self, session: DeviceSession, active: ActiveCalibration) -> None:
        """Hand calibration and table to the session, between two batches in its own thread."""
        self._compute.submit(lambda: session.set_calibration(active)).result()

    def refresh(self) -> None:
        """Do nothing: they are those of now."""

    def status(self, device_id: str) -> DeviceStatus:
        """Return the device's status; "stopped" for one never started. Never waits."""
        subscribers = self.streams.subscribers(device_id)
        opening = self._openings.get(device_id)
        if opening is not None:
            link = (
                None if opening.state == "starting" else LinkState("disconnected", opening.reason)
            )
            return DeviceStatus(opening.state, opening.reason, subscribers=subscribers, link=link)
        session = self._sessions.get(device_id)
        if session is not None:
            return session.status()
        reason = self._refused.get(device_id)
        return DeviceStatus("failed" if reason else "stopped", reason, subscribers=subscribers)

    def latencies(self) -> dict[str, tuple[tuple[int, ...], float]]:
        """Return the latencies of batches by class, and their sum [s], by device. Never waits."""
        return {name: session.latency.counts() for name, session in tuple(self._sessions.items())}

    def stage_latencies(self) -> dict[str, tuple[int, dict[Stage, float]]]:
        """Return frames that were timed, and their time in each stage [s], by device."""
        return {name: session.stages.sums() for name, session in tuple(self._sessions.items())}

    def pose_counts(self) -> dict[str, dict[str, ToolCounts]]:
        """Return pose counts by device and tool, of devices that were started. Never waits."""
        return {
            name: session.pose_counts.counts() for name, session in tuple(self._sessions.items())
        }

    def statuses(self) -> dict[str, DeviceStatus]:
        """Return the status of every device that was started, or tried to. Never waits."""
        names = {*tuple(self._sessions), *tuple(self._openings), *tuple(self._refused)}
        return {name: self.status(name) for name in sorted(names)}

    def describe(self, device_id: str) -> DeviceDescription | None:
        """Return the driver's description of a device; None: it was never started. Never waits."""
        session = self._sessions.get(device_id)
        return session.description if session else None

    def known_session(self, device_id: str) -> DeviceSession | None:
        """Return the session of a device that was started, running or not; None: it was not."""
        return self._sessions.get(device_id)

    def session(self, device_id: str) -> DeviceSession:
        """Return a running device's session; raises DeviceNotRunning. Never waits."""
        session = self._sessions.get(device_id)
        if session is None or not session.running:
            raise not_running(device_id, self.status(device_id))
        return session

    def collect(
        self, device_id: str, frames: int, marker: int | None, timeout_s: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the readings of one marker in the next frames; see ``collect_readings``."""
        return collect_readings(self, device_id, frames, marker, timeout_s)

    def close(self) -> None:
        """Stop all devices and the compute thread."""
        with self._lock:
            openings = list(self._openings.values())
            for opening in openings:
                opening.cancel()
            readers = [s.reader for s in self._sessions.values() if s.reader is not None]
            for reader in readers:
                reader.close_driver()
            self._compute.close()
            for reader in readers:
                reader.stop()
        for opening in openings:
            opening.join()
        self._watchdog.close()

    def _prepare(
        self, device_id: str, description: DeviceDescription, model: ExpectedScans
    ) -> DeviceSession:
        """Make the device's buffers; runs in the compute thread."""
        capacity = max(MIN_RING_FRAMES, int(RING_SECONDS * description.frame_rate_hz))
        ring = FrameRing(capacity)
        processor = FrameProcessor(device_id, description, self._compute_device, model)
        return DeviceSession(
            device_id, description, processor, ring, self.streams, self.poses, self.holds
        )
