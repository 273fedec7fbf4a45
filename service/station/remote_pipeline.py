"""RemotePipeline: the live side of a gateway whose devices belong to a station's process."""

import asyncio
import logging
import pickle
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from threading import Condition, Lock, RLock
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from compute.errors import LumilineError
from hardware.driver import DeviceDescription, Driver
from service.pipeline.active_calibration import NO_ACTIVE_CALIBRATION, ActiveCalibration
from service.pipeline.beam_hold_registry import BeamHoldWatchdog
from service.pipeline.detection_stage import FindProfile, Method, SearchModel, peak_method
from service.pipeline.device_session import StreamPublisher, ToolCounts
from service.pipeline.device_status import DeviceStatus
from service.pipeline.frame_batch import LatestPoses
from service.pipeline.interface import Accept, RunningDevice, StationState, any_device
from service.pipeline.stage_latency import Stage
from service.pipeline.tap_collection import collect_readings, not_running
from service.pipeline.taps import Tap, log_failed_tap
from service.pipeline.threads import call_in_loop
from service.pipeline.tracking_config import NO_TRACKING, TrackingConfig
from service.problems.errors import DeviceNotRunning, NotReady
from service.station.bus_messages import (
    BatchMessage,
    DeviceFigures,
    MessageKind,
    StationFigures,
    read_bad_pixels,
    read_description,
    read_figures,
    read_hold,
    read_poses,
    split_message,
)
from service.station.calls import Start
from service.station.remote_holds import RemoteHolds
from service.station.shared_ring import Record
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


class ClientStreams(StreamPublisher, Protocol):
    """StreamPublisher that takes batches as bytes, and tells how many clients there are."""

    def publish_message(self, message: BatchMessage) -> None:
        """Send a batch of frames, which is read when a client wants it."""
        ...

    def on_clients(self, listener: Callable[[str, int], None]) -> None:
        """Call with a device and its number of clients whenever that changes."""
        ...

    def client_counts(self) -> dict[str, int]:
        """Return the number of clients of each device that had any."""
        ...


@dataclass(eq=False)
class _AttachedTap:
    tap: Tap
    prepared: bool = False


class RemoteDevice:
    """One device of a station, from its start to its stop; see ``RunningDevice``."""

    def __init__(self, pipeline: "RemotePipeline", device_id: str, figures: DeviceFigures) -> None:
        assert figures.description is not None
        self._pipeline = pipeline
        self.device_id = device_id
        self.generation = figures.generation
        self.description: DeviceDescription = figures.description
        self._figures = figures
        self._prepared_with: ActiveCalibration | None = None
        self._missed = 0
        self._newest: int | None = None
        self._interrupted = self._resumes = False
        self._lock = RLock()
        """Held while a batch is offered: a detached tap has all that it was being given."""
        self._taps: dict[int, _AttachedTap] = {}

    def update(self, figures: DeviceFigures) -> None:
        """Take newer figures of this start."""
        self._figures = figures

    def end(self) -> None:
        """Note that nothing more comes: it was started again, or its station is lost."""
        self._figures = replace(self._figures, running=False, connected=False, drained=True)

    @property
    def running(self) -> bool:
        """Whether frames still come, or will when the device is connected again."""
        return self._figures.running

    @property
    def connected(self) -> bool:
        """Whether it runs and its device is there."""
        return self._figures.connected

    @property
    def drained(self) -> bool:
        """Whether all frames are processed, and offered to taps, and no more will come."""
        return self._figures.drained

    @property
    def active_calibration(self) -> ActiveCalibration:
        """What its newest batch was processed with."""
        active = self._prepared_with or self._pipeline.calibration(self.device_id)
        return replace(active, bad_pixels=self._figures.status.bad_pixels)

    @property
    def method(self) -> Method | None:
        """How its peaks are found; None: nothing reads its scans."""
        return peak_method(self.description)

    @property
    def search_model(self) -> SearchModel:
        """What its peaks are found with; waits for the station."""
        model: SearchModel = self._pipeline.call("search_model", self.device_id)
        return model

    @property
    def last_sequence(self) -> int:
        """Sequence number of the newest frame; -1 before the first; waits for the station."""
        number: int = self._pipeline.call("last_sequence", self.device_id)
        return number

    @property
    def frames_dropped(self) -> int:
        """Frames that taps lack: nobody took them in time, here or at the station."""
        return self._figures.status.frames_dropped_compute + self._missed

    def peak_settings(self) -> dict[str, Any]:
        """Return the method of peak detection and its errors as a JSON object."""
        return self._figures.peak_settings

    def status(self) -> DeviceStatus:
        """Return its status."""
        return self._pipeline.status(self.device_id)

    def attach(self, tap: Tap, *, sampled: bool = False) -> None:
        """Give a tap all batches from now on; ``sampled``: some seconds of a minute are enough."""
        number = self._pipeline.next_tap()
        with self._lock:
            self._taps[number] = _AttachedTap(tap)
        try:
            self._pipeline.call(
                "attach",
                self.device_id,
                self.generation,
                number,
                sampled=sampled,
                pixels=tap.wants_pixels,
            )
        except (DeviceNotRunning, NotReady):
            # It has ended meanwhile: whoever waits for its batches sees that.
            return

    def detach(self, tap: Tap) -> None:
        """Give a tap no more batches; what it was being given, it has when this returns."""
        with self._lock:
            numbers = [number for number, one in self._taps.items() if one.tap is tap]
            for number in numbers:
                del self._taps[number]
            self._resume()
            if not self._taps:
                self._interrupted, self._newest = False, None
        for number in numbers:
            self._pipeline.notify("detach", number)

    def prepare(self, number: int, active: ActiveCalibration) -> bool:
        """Tell a tap what its next batches are processed with; return whether it is of here."""
        with self._lock:
            one = self._taps.get(number)
            if one is None:
                return False
            self._prepared_with = active
            self._guarded(number, one, partial(one.tap.prepare, active))
            one.prepared = True
            self._resume()
            return True

    def _resume(self) -> None:
        """Offer batches again, once all taps know what they are processed with."""
        if self._interrupted and all(one.prepared for one in self._taps.values()):
            self._interrupted, self._resumes = False, True

    def interrupt(self) -> None:
        """Offer no more until taps know again what batches are processed with: some were missed."""
        with self._lock:
            self._interrupted = bool(self._taps)
            for one in self._taps.values():
                one.prepared = False

    def offer(self, message: BatchMessage) -> None:
        """Offer a batch to the taps that know what it was processed with."""
        with self._lock:
            if self._interrupted or not self._taps:
                return
            if self._resumes and self._newest is not None:
                self._missed += max(0, message.first_sequence - self._newest - 1)
            self._newest, self._resumes = message.last_sequence, False
            batch = message.read()
            for number, one in tuple(self._taps.items()):
                if one.prepared:
                    self._guarded(number, one, partial(one.tap.offer, batch))

    def _guarded(self, number: int, one: _AttachedTap, act: Callable[[], object]) -> None:
        """Let a tap do something; one that fails has no more, and the device goes on."""
        try:
            act()
        except Exception as error:  # noqa: BLE001 - of the tap, not of the device
            self._taps.pop(number, None)
            self._pipeline.notify("detach", number)
            log_failed_tap(self.device_id, one.tap, error)


@dataclass(eq=False)
class _StartedDevice:
    """How a device was started, for a station that takes the place of a lost one."""

    driver: bytes
    accept: Accept
    station: StationProcess | None = None
    """The last that has started it."""


class RemotePipeline:
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
        self.streams = streams
        self.poses = LatestPoses()
        """The newest poses of all tools."""
        self.holds = RemoteHolds(
            lambda hold_id: bool(self.call("acknowledge", hold_id)),
            lambda reference_id: self.notify("set_up", reference_id),
            streams.publish_hold,
        )
        """Whether beams are held."""
        self._watchdog = BeamHoldWatchdog(self.holds)
        self._loop = asyncio.get_running_loop()
        self._loop_thread = threading.get_ident()
        level = logging.getLogger().getEffectiveLevel()
        self._start = Start(compute_device, find_profile, level, priority, cores)
        self._figures = StationFigures({}, ready=False)
        self._devices: dict[str, RemoteDevice] = {}
        self._started: dict[str, _StartedDevice] = {}
        self._calibrations: dict[str, dict[int, ActiveCalibration]] = {}
        self._tracked: dict[str, TrackingConfig] = {}
        self._versions = count(1)
        self._tap_numbers = count(1)
        self._away: dict[str, DeviceFigures] = {}
        """Devices of a lost station that are not started again yet."""
        self._lock = RLock()
        self._turns: dict[str, RLock] = {}
        self._passed = Condition()
        """Notified when more of the bus was read."""
        self._due = 0
        self._read_to = 0
        """Position of the bus up to which all is taken."""
        self._closing = False
        self._starter = starter
        self._restarts = self._failures = self._messages_missed = 0
        self._began_s = time.monotonic()
        self._replacing = Lock()
        """Held while another station takes a lost one's place."""
        self._reading: StationProcess | None = None
        """Whose messages are read; of the event loop alone."""
        self._station = StationProcess(self._starter, self._start, self._lost)
        self._begin_reading(self._station)
        streams.on_clients(lambda device_id, number: self.notify("set_clients", device_id, number))

    @property
    def ready(self) -> bool:
        """Whether the station processes frames."""
        return self._figures.ready

    @property
    def busy_s(self) -> float:
        """Time that the station has spent on its current batch or job [s]."""
        return self._figures.busy_s

    @property
    def station(self) -> StationState:
        """The process that devices belong to."""
        figures = self._figures
        return StationState(
            self._station.process_id,
            self._restarts,
            self._messages_missed,
            figures.memory_bytes,
            figures.cpu_s,
        )

    def next_tap(self) -> int:
        """Return a number for a tap."""
        return next(self._tap_numbers)

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

    def status(self, device_id: str) -> DeviceStatus:
        """Return the device's status; "stopped" for one never started. Never waits."""
        found = self._figures.devices.get(device_id)
        gone = device_id in self._away and device_id not in self._started
        status = DeviceStatus("stopped") if found is None or gone else found.status
        return replace(status, subscribers=self.streams.subscribers(device_id))

    def statuses(self) -> dict[str, DeviceStatus]:
        """Return the status of every device that was started, or tried to. Never waits."""
        return {device_id: self.status(device_id) for device_id in self._figures.devices}

    def latencies(self) -> dict[str, tuple[tuple[int, ...], float]]:
        """Return the latencies of batches by class, and their sum [s], by device. Never waits."""
        return {name: one.latency for name, one in self._ran().items()}

    def stage_latencies(self) -> dict[str, tuple[int, dict[Stage, float]]]:
        """Return frames that were timed, and their time in each stage [s], by device."""
        return {name: one.stages for name, one in self._ran().items()}

    def pose_counts(self) -> dict[str, dict[str, ToolCounts]]:
        """Return pose counts by device and tool, of devices that were started. Never waits."""
        return {
            name: {
                tool: ToolCounts(Counter(frames), newest_ns)
                for tool, (frames, newest_ns) in one.tools.items()
            }
            for name, one in self._ran().items()
        }

    def describe(self, device_id: str) -> DeviceDescription | None:
        """Return the driver's description of a device; None: it was never started. Never waits."""
        found = self._figures.devices.get(device_id)
        return None if found is None else found.description

    def session(self, device_id: str) -> RunningDevice:
        """Return a running device; raises DeviceNotRunning. Never waits."""
        device = self._devices.get(device_id)
        if device is None or not device.running:
            raise not_running(device_id, self.status(device_id))
        return device

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

    def _ran(self) -> dict[str, DeviceFigures]:
        return {
            name: one for name, one in self._figures.devices.items() if one.description is not None
        }

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
                self._take(record)
            except Exception:  # noqa: BLE001 - of this message; the next ones go on
                _log.exception("a message of the station was not understood")
        # Less than were rung for: some were overwritten.
        self._due = self._due - count_read if count_read == min(self._due, TURN) else 0
        station.reader.report_progress()
        with self._passed:
            self._read_to = station.reader.position
            self._passed.notify_all()
        if self._due:
            self._loop.call_soon(self._read_on, station)

    def _resynchronise(self, missed: int) -> None:
        """Ask for what may be among the messages that were missed."""
        self._messages_missed += missed
        for device in self._devices.values():
            device.interrupt()
        for device_id in self.holds.all():
            self._keep_configured_holds(device_id)
        self.notify("resynchronise")

    def _read_on(self, station: StationProcess) -> None:
        if station is self._station and self._due:
            self._read()

    def _take(self, record: Record) -> None:
        kind, header, end = split_message(record.data)
        if kind is MessageKind.BATCH:
            self._take_batch(BatchMessage(record.data, header, end, self.holds))
        elif kind is MessageKind.POSES:
            self.poses.put(read_poses(header))
        elif kind is MessageKind.HOLD:
            device_id, row, last = header
            self.holds.change(device_id, read_hold(row, self.holds), last=last)
        elif kind is MessageKind.FIGURES:
            self._take_figures(read_figures(header[0]))
        elif kind is MessageKind.STATE:
            device_id, state, reason, link, described = header
            if state in _ENDED or state == "disconnected":
                self.poses.remove(device_id)
            description = read_description(described)
            self.streams.publish_status(device_id, state, reason, link, description)
        elif kind is MessageKind.CALIBRATION:
            self._prepare(*header)
        else:
            self.streams.end(*header)

    def _take_batch(self, message: BatchMessage) -> None:
        device_id = message.device_id
        if message.holds:
            self.holds.take(device_id, message.holds[-1])
        device = self._devices.get(device_id)
        if device is not None:
            device.offer(message)
        message.drop_pixels()
        self.streams.publish_message(message)

    def _take_figures(self, figures: StationFigures) -> None:
        away = {name: one for name, one in self._away.items() if name not in figures.devices}
        # Not "stopped" while it is their turn to be started again.
        self._away = {name: one for name, one in away.items() if name in self._started}
        for device_id in away.keys() - self._away.keys():
            self.streams.publish_status(device_id, "stopped")
        if self._away:
            figures = replace(figures, devices=self._away | figures.devices)
        self._figures = figures
        for device_id, one in figures.devices.items():
            known = self._devices.get(device_id)
            if known is not None and known.generation == one.generation:
                known.update(one)
            elif one.running:
                if known is not None:
                    known.end()
                self._devices[device_id] = RemoteDevice(self, device_id, one)
        for device_id in self._devices.keys() - figures.devices.keys():
            self._devices.pop(device_id).end()

    def _prepare(self, tap: int, version: int, masked: bytes) -> None:
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
            self._began_s = time.monotonic()
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
            self._tell_lost(why)
        finally:
            self._release(station)

    def _tell_lost(self, why: str) -> None:
        """Tell that the devices of a station are away, or have ended with it."""
        reason = f"the process that owns the devices has ended ({why}) and is started again"
        self.holds.fail(reason)
        figures, away = {}, {}
        for device_id, one in self._figures.devices.items():
            device = self._devices.pop(device_id, None)
            if device is not None:
                device.end()
            if device_id in self._started:
                status = replace(one.status, state="starting", reason=reason)
                away[device_id] = DeviceFigures(status, description=one.description)
            elif one.status.state in _ENDED:
                status = one.status
            else:
                status = replace(one.status, state="stopped", reason=None)  # as it was told to
            figures[device_id] = away.get(device_id) or replace(
                one, status=status, generation=0, running=False, connected=False
            )
            if status is not one.status:
                self.poses.remove(device_id)
                self.streams.publish_status(device_id, status.state, status.reason)
        self._figures = StationFigures(figures, ready=False)
        self._away = away

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
