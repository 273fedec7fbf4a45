"""RemotePipeline: the live side of a gateway whose devices belong to a station's process."""

import asyncio
import logging
import pickle
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import count
from threading import Condition, Lock, RLock
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import LumilineError
from hardware.driver import DeviceDescription, Driver
from service.pipeline.active_calibration import NO_ACTIVE_CALIBRATION, ActiveCalibration
from service.pipeline.beam_hold_registry import BeamHoldWatchdog
from service.pipeline.detection_stage import FindProfile
from service.pipeline.frame_batch import LatestPoses
from service.pipeline.interface import Accept, StationState, any_device
from service.pipeline.tap_collection import collect_readings
from service.pipeline.threads import call_in_loop
from service.pipeline.tracking_config import NO_TRACKING, TrackingConfig
from service.problems.errors import NotReady
from service.station.bus_messages import (
    read_bad_pixels,
)
from service.station.calls import Start
from service.station.station_mirror import ClientStreams, StationMirror
from service.station.station_process import StationProcess
from service.station.station_starter import StationStarter

_log = logging.getLogger(__name__)

TURN: Final = 64
"""Messages of the bus that are taken before the event loop does something else."""
KEPT_CALIBRATIONS: Final = 8
"""Newest calibrations of a device that its batches may still be processed with."""
_ENDED: Final = ("stopped", "failed", "ended")
"""States of a device of which no frames come."""
RESTART_S: Final = (0.0, 0.5, 1.0, 2.0, 5.0)
"""Until a station that was lost is started again; the last for all that follow."""
STEADY_S: Final = 60.0
"""A station that has run for this long is started again at once."""
REFRESH_S: Final = 1.0
"""How long a question for a device's state waits for the station."""
_PASS_S: Final = 10.0
"""How long a call waits for what it caused to come by the bus."""


@dataclass(eq=False)
class _StartedDevice:
    """How a device was started, for a station that takes the place of a lost one."""

    driver: bytes
    accept: Accept
    station: StationProcess | None = None
    """The last that has started it."""


class RemotePipeline(StationMirror):
    """Starts and stops devices in a station's process; made in the event loop of its clients.

    What comes by the bus is taken in that loop. Methods that change something wait for the station,
    and for what they caused to have come by: they are called in other threads.

    A station that ends without being asked to is started again, with the devices, calibrations and
    tools of the last one. Meanwhile its devices are "starting", its beams are held.

    Args:
        streams: takes the results for the clients.
        starter: starts the station; stays the caller's.
        compute_device: "cpu", "cuda:0", ...; None: the best there is.
        find_profile: returns the device profiles that descriptions name; can be pickled.
        priority: of real time for the station, 1 to 99; None: as all others.
        cores: numbers of the cores that it may use; empty: all.
    """

    def __init__(
        self,
        streams: ClientStreams,
        starter: StationStarter,
        compute_device: str | None,
        find_profile: FindProfile,
        priority: int | None = None,
        cores: tuple[int, ...] = (),
    ) -> None:
        super().__init__(streams, LatestPoses())
        self._watchdog = BeamHoldWatchdog(self.holds)
        self._loop = asyncio.get_running_loop()
        self._loop_thread = threading.get_ident()
        level = logging.getLogger().getEffectiveLevel()
        self._start = Start(compute_device, find_profile, level, priority, cores)
        self._started: dict[str, _StartedDevice] = {}
        self._calibrations: dict[str, dict[int, ActiveCalibration]] = {}
        self._tracked: dict[str, TrackingConfig] = {}
        self._versions = count(1)
        self._lock = RLock()
        self._turns: dict[str, RLock] = {}
        self._passed = Condition()
        """Notified when more of the bus was read."""
        self._due = 0
        self._read_to = 0
        """Position of the bus up to which all is taken."""
        self._closing = False
        self._starter = starter
        self._restarts = self._failures = 0
        self._began_s, self._since_ns = time.monotonic(), time.time_ns()
        self._why_lost: str | None = None
        self._replacing = Lock()
        """Held while another station takes a lost one's place."""
        self._reading: StationProcess | None = None
        """Whose messages are read; of the event loop alone."""
        self._station = StationProcess(self._starter, self._start, self._lost)
        self._begin_reading(self._station)
        streams.on_clients(lambda device_id, number: self.notify("set_clients", device_id, number))

    @property
    def stations(self) -> tuple[StationState, ...]:
        """The process that devices belong to."""
        figures = self._figures
        state = StationState(
            self._station.process_id,
            self._restarts,
            self._messages_missed,
            figures.memory_bytes,
            figures.cpu_s,
            state="running" if self.ready else "starting",
            reason=None if self.ready else self._why_lost,
            since_ns=self._since_ns,
            devices=len(figures.devices),
        )
        return (state,)

    def call(self, method: str, *args: Any, **members: Any) -> Any:
        """Call a method of the station; returns when all that it caused has come by the bus.

        Raises:
            NotReady: there is no station now.
            LumilineError: what the method raised; RuntimeError for any other error.
        """
        if threading.get_ident() == self._loop_thread:
            raise RuntimeError(f"{method} waits for the event loop, and was called in it")
        station = self._station
        answer = station.call(method, *args, **members)
        with self._passed:
            self._passed.wait_for(
                lambda: station is not self._station or self._read_to >= answer.head,
                _PASS_S,
            )
        # What failed has changed something, too.
        if answer.error is not None:
            raise answer.error
        return answer.result

    def _call_or_lose(self, method: str, device_id: str) -> bool:
        """Call a method that ends a device; return whether there was a station to do it.

        Where there is none, the device has ended with the last one, and what clients are told of
        that has come by when this returns.
        """
        station = self._station
        try:
            self.call(method, device_id)
        except NotReady:
            with self._passed:
                self._passed.wait_for(lambda: self._reading is not station, _PASS_S)
            return False
        return True

    def notify(self, method: str, *args: Any) -> None:
        """Call a method of the station whose answer nobody needs."""
        self._station.notify(method, *args)

    def start_device(
        self,
        device_id: str,
        driver: Driver,
        active: ActiveCalibration = NO_ACTIVE_CALIBRATION,
        accept: Accept = any_device,
    ) -> DeviceDescription | None:
        """Open the driver and start its reader; raises LumilineError when it cannot be opened."""
        started = _StartedDevice(pickle.dumps(driver), accept)
        with self._turn(device_id):
            version = self._remember(device_id, active)
            with self._lock:
                self._started[device_id] = started
            started.station = self._station
            try:
                description: DeviceDescription | None = self.call(
                    "start_device", device_id, started.driver, active, version, accept
                )
            except NotReady:
                raise  # the next station starts it
            except BaseException:
                with self._lock:
                    del self._started[device_id]
                raise
            return description

    def stop_device(self, device_id: str) -> None:
        """Stop the device and close its driver; nothing happens when it is not running."""
        with self._turn(device_id):
            with self._lock:
                self._started.pop(device_id, None)
            self._call_or_lose("stop_device", device_id)
            self.poses.remove(device_id)

    def forget_device(self, device_id: str) -> None:
        """Stop the device, drop its counters and end its streams: it is deleted."""
        with self._turn(device_id):
            with self._lock:
                self._started.pop(device_id, None)
                self._tracked.pop(device_id, None)
            told = self._call_or_lose("forget_device", device_id)
            self.holds.keep(device_id, frozenset())
            if not told:
                call_in_loop(self._loop, self._forget_lost, device_id)
            with self._lock:
                self._calibrations.pop(device_id, None)
            self.poses.remove(device_id)

    def set_calibration(self, device_id: str, active: ActiveCalibration) -> None:
        """Switch calibration and table between two frames; nothing happens when it is not running.

        Nor when the device runs with other sensors than the calibration's.
        """
        with self._turn(device_id):
            version = self._remember(device_id, active)
            with suppress(NotReady):  # the next station is told
                self.call("set_calibration", device_id, active, version)

    def set_tracking_config(self, device_id: str, tracked: TrackingConfig) -> None:
        """Set a device's tracking configuration: from the next batch on, or once it is started."""
        with self._turn(device_id):
            with self._lock:
                self._tracked[device_id] = tracked
            with suppress(NotReady):  # the next station is told
                self.call("set_tracking_config", device_id, tracked)
            self._keep_configured_holds(device_id)
            if not tracked.tools:
                self.poses.remove(device_id)

    def tracked(self, device_id: str) -> TrackingConfig:
        """Return a device's tracking configuration, now or once it is started."""
        return self._tracked.get(device_id, NO_TRACKING)

    def calibration(self, device_id: str) -> ActiveCalibration:
        """Return the calibration that a device was last told to use."""
        with self._lock:
            known = self._calibrations.get(device_id)
            return known[max(known)] if known else NO_ACTIVE_CALIBRATION

    def refresh(self) -> None:
        """Wait until statuses and counters are those of now; while there is no station, they are.

        A station that has too much to do is not waited for: they are the last that it sent.
        """
        station = self._station
        with suppress(NotReady, TimeoutError):
            answer = station.call_within(REFRESH_S, "refresh")
            with self._passed:
                self._passed.wait_for(
                    lambda: station is not self._station or self._read_to >= answer.head,
                    REFRESH_S,
                )

    def collect(
        self, device_id: str, frames: int, marker: int | None, timeout_s: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the readings of one marker in the next frames; see ``collect_readings``."""
        return collect_readings(self, device_id, frames, marker, timeout_s)

    def close(self) -> None:
        """Stop all devices, and the station."""
        with self._replacing:
            self._closing = True
            station = self._station
        station.close()
        ended = threading.Event()

        def release() -> None:
            self._release(station)
            ended.set()

        call_in_loop(self._loop, release)
        ended.wait(_PASS_S)
        self._watchdog.close()

    def _keep_configured_holds(self, device_id: str) -> None:
        """Forget the holds that a device has no more: another station has never known them."""
        self.holds.keep(device_id, {hold.id for hold in self.tracked(device_id).holds})

    def _turn(self, device_id: str) -> RLock:
        """Return what is held while a device is commanded: one command after another.

        A station that takes the place of a lost one is told the same as the one before, while
        others command it.
        """
        with self._lock:
            return self._turns.setdefault(device_id, RLock())

    def _remember(self, device_id: str, active: ActiveCalibration) -> int:
        version = next(self._versions)
        with self._lock:
            known = self._calibrations.setdefault(device_id, {})
            known[version] = active
            while len(known) > KEPT_CALIBRATIONS:
                del known[min(known)]
        return version

    def _read(self) -> None:
        """Take what has come by the bus; called in the event loop."""
        station = self._station
        self._due += station.doorbell.clear()
        count_read = 0
        for record in station.reader.read(min(self._due, TURN)):
            count_read += 1
            if record.missed:
                self._resynchronise(record.missed)
            try:
                self._take(record.data)
            except Exception:  # noqa: BLE001 - of this message; the next ones go on
                _log.exception("a message of the station was not understood")
        # Less than were rung for: some were overwritten.
        self._due = self._due - count_read if count_read == min(self._due, TURN) else 0
        if self._unoffered:
            # Behind the clients, which are awake now.
            self._loop.call_soon(self._end_turn, station)
        else:
            self._end_turn(station)
        if self._due:
            self._loop.call_soon(self._read_on, station)

    def _end_turn(self, station: StationProcess) -> None:
        """Offer the taps what was read, and tell those who wait for it."""
        if self._reading is not station:
            return
        self._offer()
        station.reader.report_progress()
        with self._passed:
            self._read_to = station.reader.position
            self._passed.notify_all()

    def _resynchronise(self, missed: int) -> None:
        """Ask for what may be among the messages that were missed."""
        self._messages_missed += missed
        self._interrupt()
        for device_id in self.holds.all():
            self._keep_configured_holds(device_id)
        self.notify("resynchronise")

    def _read_on(self, station: StationProcess) -> None:
        if station is self._station and self._due:
            self._read()

    def _comes_back(self, device_id: str) -> bool:
        """Whether a device of a lost station is started again."""
        return device_id in self._started

    def _take_calibration(self, tap: int, version: int, masked: bytes) -> None:
        bad_pixels = read_bad_pixels(masked)
        for device_id, device in self._devices.items():
            with self._lock:
                active = self._calibrations.get(device_id, {}).get(version, NO_ACTIVE_CALIBRATION)
            if device.prepare(tap, replace(active, bad_pixels=bad_pixels)):
                return

    def _lost(self, station: StationProcess, why: str) -> None:
        """Start another station in place of one that has ended; called in a thread of its own."""
        if self._closing:
            return
        _log.critical("the station has ended (%s); it is started again", why)
        done: threading.Event = threading.Event()

        def end() -> None:
            try:
                self._end_station(station, why)
            finally:
                done.set()

        call_in_loop(self._loop, end)
        done.wait()
        self._restarts += 1
        if time.monotonic() - self._began_s > STEADY_S:
            self._failures = 0
        while not self._closing and not self._replace():
            pass
        if not self._closing:
            self._restore()

    def _replace(self) -> bool:
        """Start another station, after a while if the last ones did not last; return whether."""
        time.sleep(RESTART_S[min(self._failures, len(RESTART_S) - 1)])
        self._failures += 1
        with self._replacing:
            if self._closing:
                return False
            self._began_s, self._since_ns = time.monotonic(), time.time_ns()
            try:
                self._station = StationProcess(self._starter, self._start, self._lost)
            except OSError as error:
                _log.critical("no other station can be started now: %s", error)
                return False
        call_in_loop(self._loop, self._begin_reading, self._station)
        return True

    def _begin_reading(self, station: StationProcess) -> None:
        self._loop.add_reader(station.doorbell.descriptor, self._read)
        self._reading, self._read_to = station, 0

    def _release(self, station: StationProcess) -> None:
        """Read a station's messages no more; one that was lost is released already."""
        if self._reading is station:
            self._offer()
            self._reading, self._due = None, 0
            self._loop.remove_reader(station.doorbell.descriptor)
            station.release()
            with self._passed:
                self._passed.notify_all()

    def _end_station(self, station: StationProcess, why: str) -> None:
        """Take the last messages of a station, and tell that its devices are away."""
        if self._reading is not station:
            return  # closed meanwhile
        try:
            self._due = 1 << 30
            while self._due:
                self._read()
            self._offer()
            reason = f"the process that owns the devices has ended ({why}) and is started again"
            self._why_lost, self._since_ns = reason, time.time_ns()
            self._tell_lost("starting", reason)
        finally:
            self._release(station)

    def _forget_lost(self, device_id: str) -> None:
        """Forget a device that was deleted while there was no station."""
        self._away.pop(device_id, None)
        devices = {name: one for name, one in self._figures.devices.items() if name != device_id}
        self._figures = replace(self._figures, devices=devices)
        self.streams.end(device_id)

    def _restore(self) -> None:
        """Start the devices of the station before, as they were."""
        with self._lock:
            tracked, started = tuple(self._tracked), tuple(self._started)
        for device_id, number in self.streams.client_counts().items():
            self.notify("set_clients", device_id, number)
        try:
            for device_id in {*tracked, *self.holds.all()}:
                with self._turn(device_id):
                    self._configure_again(device_id)
            for device_id in started:
                with self._turn(device_id):
                    self._start_again(device_id)
        except NotReady:
            return  # that station is lost, too: its successor begins anew

    def _configure_again(self, device_id: str) -> None:
        """Track what a device tracked; raises NotReady."""
        try:
            self.call("set_tracking_config", device_id, self.tracked(device_id))
        except NotReady:
            raise
        except Exception:  # noqa: BLE001 - the others are tracked all the same
            _log.exception("device %s does not follow its tools as before", device_id)
        self._keep_configured_holds(device_id)

    def _start_again(self, device_id: str) -> None:
        """Start a device as it was, unless it was stopped or started meanwhile; raises NotReady."""
        one = self._started.get(device_id)
        if one is None or one.station is self._station:
            return
        one.station = self._station
        active = self.calibration(device_id)
        version = self._remember(device_id, active)
        try:
            self.call("start_device", device_id, one.driver, active, version, one.accept)
        except NotReady:
            raise
        except LumilineError as error:
            _log.error("device %s was not started again: %s", device_id, error.detail)
        except Exception:  # noqa: BLE001 - the others are started all the same
            with self._lock:
                del self._started[device_id]
            _log.exception("device %s was not started again", device_id)
