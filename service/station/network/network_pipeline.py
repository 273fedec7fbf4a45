"""NetworkPipeline: the devices of a station on another machine, as a gateway has them.

Messages are taken in the event loop of the gateway's clients. Methods that change something ask the
station, with a deadline, and wait until what they caused has come by; they are called in other
threads.
"""

import asyncio
import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from threading import Condition
from typing import Any, Final

from compute.errors import LumilineError
from service.pipeline.active_calibration import NO_ACTIVE_CALIBRATION, ActiveCalibration
from service.pipeline.beam_hold_registry import BeamHoldWatchdog
from service.pipeline.device_status import DeviceStatus
from service.pipeline.frame_batch import BeamEnableToken, BeamHoldState, LatestPoses
from service.pipeline.interface import StationStanding, StationState
from service.pipeline.tracking_config import NO_TRACKING, TrackingConfig
from service.problems.errors import NotReady, StationNotReached
from service.station.bus_messages import BatchMessage, MessageKind, read_bad_pixels, read_hold
from service.station.network.clock_bound import ClockBound
from service.station.network.connection import BusConnection
from service.station.network.envelope import Reassembly, unpack
from service.station.network.messages import (
    BadRequest,
    Positions,
    Presence,
    Reply,
    deadline_s,
    pack_request,
    read_presence,
    read_reply,
)
from service.station.network.search_models import read_search_model
from service.station.network.subjects import BATCH, CALL, PIXELS, subject
from service.station.remote_device import RemoteDevice
from service.station.remote_holds import RemoteHolds
from service.station.station_mirror import ENDED, ClientStreams, StationMirror

_log = logging.getLogger(__name__)

ASK_S: Final = 1.0
"""Time between two questions whether a station is there."""
LOST_S: Final = 2.5
"""A station that has said nothing for so long is lost."""
PASS_S: Final = 3.0
"""How long a call waits for what it caused to come by the bus."""
AGAIN_S: Final = 0.25
"""Least time between two requests to say everything again."""
BACKLOG: Final = 4096
"""Messages of frames that wait for a calibration to be read from the database."""

StoredIds = tuple[str | None, str | None, str | None]
"""Ids of calibration, correction table and radiometric calibration."""


@dataclass(frozen=True)
class StoredReader:
    """Reads what the database has of devices; called in threads.

    Args:
        device: what a device uses and tracks.
        calibration: a calibration by its ids.
    """

    device: Callable[[str], tuple[ActiveCalibration, TrackingConfig]]
    calibration: Callable[[StoredIds], ActiveCalibration]


class LocalTokens:
    """Tokens of beam holds whose deadlines are those of another machine's clock."""

    def __init__(self, holds: RemoteHolds, clock: ClockBound) -> None:
        self._holds = holds
        self._clock = clock

    def enabled(self, hold_id: str, revision: int, due_s: float) -> BeamEnableToken:
        """Return the token of a state that is not held: until the earliest its deadline can be."""
        local_s = self._clock.local_s(due_s, time.monotonic())
        return self._holds.enabled(hold_id, revision, local_s)

    def held(self, now: BeamHoldState) -> None:
        """End the token of a hold."""
        self._holds.held(now)


class NetworkPipeline(StationMirror):
    """Mirrors one station; made in the event loop of its clients.

    Args:
        name: of the station.
        gateway: of this process; another for each.
        streams: takes the results for the clients.
        poses: takes the newest poses of all tools.
        connection: to the bus; stays the caller's.
        stored: reads the database.
    """

    def __init__(
        self,
        name: str,
        gateway: str,
        streams: ClientStreams,
        poses: LatestPoses,
        connection: BusConnection,
        stored: StoredReader,
    ) -> None:
        super().__init__(streams, poses)
        self.name = name
        self._gateway = gateway
        self._connection = connection
        self._stored = stored
        self._clock = ClockBound()
        self._tokens = LocalTokens(self.holds, self._clock)
        self._watchdog = BeamHoldWatchdog(self.holds)
        self._loop = asyncio.get_running_loop()
        self._loop_thread = threading.get_ident()
        self._subjects: dict[tuple[str, str | None], Reassembly] = {}
        self._incarnation: str | None = None
        self._presence: Presence | None = None
        self._heard_s: float | None = None
        self._lost: str | None = "it has not been heard of"
        self._since_ns = time.time_ns()
        self._round_trip_s: float | None = None
        self._configured: dict[str, tuple[ActiveCalibration, TrackingConfig]] = {}
        self._digests: dict[str, str] = {}
        self._calibrations: dict[StoredIds, ActiveCalibration] = {}
        self._backlog: deque[tuple[str, bytes]] | None = None
        """Messages of frames that wait for a calibration to be read; None: none has to."""
        self._targets: Positions = {}
        """What the station had said half a second ago."""
        self._past: set[str] = set()
        """Incarnations that are over: what comes late of them is nobody's."""
        self._pixels: dict[str, Any] = {}
        """Subscriptions to the pixels of devices."""
        self._passed = Condition()
        """Notified when more was read."""
        self._asking = False
        self._ask_again = False
        self._tasks: set[asyncio.Task[None]] = set()
        self._readers = ThreadPoolExecutor(1, thread_name_prefix=f"stored-{name}")
        self._task = self._loop.create_task(self._keep_asking())

    # What is known without asking.

    @property
    def reached(self) -> bool:
        """Whether the station is there."""
        return self._lost is None

    @property
    def standing(self) -> StationState:
        """How it stands."""
        presence, figures = self._presence, self._figures
        state: StationStanding = "running" if self._lost is None else "lost"
        if presence is not None and presence.complaint is not None and self._lost is None:
            state = "limited"
        return StationState(
            process_id=presence.process_id if presence else 0,
            restarts=presence.restarts if presence else 0,
            messages_missed=self._messages_missed + (presence.messages_missed if presence else 0),
            memory_bytes=figures.memory_bytes,
            cpu_s=figures.cpu_s,
            name=self.name,
            state=state,
            reason=self._lost or (presence.complaint if presence else None),
            since_ns=self._since_ns,
            round_trip_s=self._round_trip_s if self._lost is None else None,
            host=presence.host if presence else None,
            devices=len(self._figures.devices),
        )

    def status(self, device_id: str) -> DeviceStatus:
        """Return the device's status; of a lost station, with why. Never waits."""
        found = super().status(device_id)
        if self._lost is None or self.knows(device_id):
            return found
        return replace(found, reason=f'the station "{self.name}" is lost: {self._lost}')

    def knows(self, device_id: str) -> bool:
        """Whether the station has said anything of a device."""
        return device_id in self._figures.devices

    def calibration(self, device_id: str) -> ActiveCalibration:
        """Return the calibration that a device uses, as far as this gateway has read."""
        found = self._configured.get(device_id)
        return NO_ACTIVE_CALIBRATION if found is None else found[0]

    def tracked(self, device_id: str) -> TrackingConfig:
        """Return a device's tracking configuration, as far as this gateway has read."""
        found = self._configured.get(device_id)
        return NO_TRACKING if found is None else found[1]

    def remember(
        self,
        device_id: str,
        active: ActiveCalibration | None = None,
        tracked: TrackingConfig | None = None,
    ) -> None:
        """Note what the database has of a device."""
        before = self._configured.get(device_id, (NO_ACTIVE_CALIBRATION, NO_TRACKING))
        self._configured[device_id] = (active or before[0], tracked or before[1])

    # Calls.

    def call(self, method: str, *args: Any, **members: Any) -> Any:
        """Ask the station; returns when all that it caused has come by.

        Raises:
            StationNotReached: it did not answer in time; it may have done it all the same.
            LumilineError: what it raised.
        """
        if threading.get_ident() == self._loop_thread:
            raise RuntimeError(f"{method} waits for the event loop, and was called in it")
        if method == "attach":
            members["gateway"] = self._gateway
            self._follow_pixels()
        asked = asyncio.run_coroutine_threadsafe(self._ask(method, args, members), self._loop)
        reply = asked.result(deadline_s(method, lost=False) + PASS_S)
        self._wait_for(reply)
        if reply.error is not None:
            raise reply.error
        if method == "search_model":
            return read_search_model(reply.result)
        return reply.result

    def notify(self, method: str, *args: Any) -> None:
        """Ask the station for something whose answer nobody needs.

        Taps are not detached one by one: the next question tells which ones there still are.
        """
        if method == "detach":
            self._follow_pixels()
            self._soon(self._say_hello)
        else:
            self._soon(self._ask_quietly, method, args)

    def clients_changed(self) -> None:
        """Tell the station how many clients there are now."""
        self._soon(self._say_hello)

    def start(self, device_id: str) -> None:
        """Have the station start a device as the database says; raises what that raises."""
        self.call("start", device_id)

    def sensors(self, device_id: str, source: Any) -> list[dict[str, Any]]:
        """Return the sensors that a source has at the station's machine."""
        found: list[dict[str, Any]] = self.call("sensors", device_id, source)
        return found

    def stop_device(self, device_id: str) -> None:
        """Stop the device and close its driver; nothing happens when it is not running."""
        self.call("stop", device_id)

    def forget_device(self, device_id: str) -> None:
        """Have the station forget a device: it is deleted, or of another station now."""
        self._configured.pop(device_id, None)
        with suppress(StationNotReached):  # it sees it in the database
            self.call("forget", device_id)

    def set_calibration(self, device_id: str, active: ActiveCalibration) -> None:
        """Have the station take over what the database says of a device."""
        self.remember(device_id, active=active)
        self._apply(device_id)

    def set_tracking_config(self, device_id: str, tracked: TrackingConfig) -> None:
        """Have the station take over what the database says of a device."""
        self.remember(device_id, tracked=tracked)
        self._apply(device_id)

    def _apply(self, device_id: str) -> None:
        try:
            self.call("apply", device_id)
        except StationNotReached as error:
            raise StationNotReached(
                f'it is stored, but the station "{self.name}" of device "{device_id}" was not '
                f"reached ({error.detail}); it takes it over by itself, within seconds once it "
                "reaches the database",
                part="station",
                station=self.name,
                device_id=device_id,
            ) from error

    def refresh(self) -> None:
        """Wait until statuses and counters are those of now; of a lost station they are the last.

        Nor is one waited for that has too much to do.
        """
        if self.reached:
            with suppress(NotReady, LumilineError):
                self.call("refresh")

    async def end(self) -> None:
        """End; called in the event loop."""
        for task in (self._task, *self._tasks):
            task.cancel()
        await asyncio.gather(self._task, *self._tasks, return_exceptions=True)
        await asyncio.get_running_loop().run_in_executor(None, self._watchdog.close)
        self._readers.shutdown(wait=False, cancel_futures=True)

    async def _ask(self, method: str, args: Any, members: Any) -> Reply:
        timeout_s = deadline_s(method, lost=self._lost is not None)
        try:
            answer = await self._connection.request(
                subject(self.name, CALL, method), pack_request(args, members), timeout_s
            )
            return read_reply(answer)
        except StationNotReached as error:
            raise StationNotReached(
                f'the station "{self.name}" was not reached: {error.detail}',
                part="station",
                station=self.name,
            ) from error
        except BadRequest as error:
            raise StationNotReached(
                f'the station "{self.name}" is of another version: {error}',
                part="station",
                station=self.name,
            ) from error

    async def _ask_quietly(self, method: str, args: Any) -> None:
        with suppress(LumilineError):
            reply = await self._ask(method, args, {})
            if reply.error is not None:
                _log.warning("station %s: %s: %s", self.name, method, reply.error.detail)

    def _wait_for(self, reply: Reply) -> None:
        with self._passed:
            self._passed.wait_for(
                lambda: (
                    not self.reached
                    or self._incarnation != reply.incarnation
                    or self._has_read(reply.positions)
                ),
                PASS_S,
            )

    def _has_read(self, positions: Positions) -> bool:
        for words, number in positions.items():
            kind, _, device = words.partition(".")
            read = self._subjects.get((kind, device or None))
            if kind != PIXELS and (read is None or read.number < number):
                return False
        return True

    def _soon(self, act: Callable[..., Any], *args: Any) -> None:
        def begin() -> None:
            task = self._loop.create_task(act(*args))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

        with suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(begin)

    # Presence.

    async def _keep_asking(self) -> None:
        while True:
            # Not waited for: that it is lost shows by its silence.
            self._soon(self._say_hello)
            await asyncio.sleep(ASK_S)
            heard_s = self._heard_s
            if self._lost is None and heard_s is not None:
                silent_s = time.monotonic() - heard_s
                if silent_s > LOST_S:
                    why = f"the station has said nothing for {silent_s:.1f} s"
                    self._lose(why if self._connection.connected else self._connection.reason)

    async def _say_hello(self) -> None:
        """Ask whether it is there, and tell what this gateway wants of it."""
        if not self._connection.connected:
            return
        counts = self.streams.client_counts()
        clients = {name: number for name, number in counts.items() if number and self.knows(name)}
        taps = [number for device in tuple(self._devices.values()) for number in tuple(device.taps)]
        asked_s = time.monotonic()
        with suppress(StationNotReached):
            reply = await self._ask("hello", (self._gateway, clients, taps), {})
            self._round_trip_s = time.monotonic() - asked_s
            if reply.incarnation != self._incarnation:
                return  # its next message tells of it
            self._clock.add(asked_s, reply.station_s)

    def _begin(self, incarnation: str) -> None:
        """Take that another process is the station now."""
        if self._incarnation is not None:
            self._past.add(self._incarnation)
            self._lose("the station's process was started again")
        self._incarnation = incarnation
        self._subjects.clear()
        self._targets = {}
        self._clock.clear()
        self._soon(self._say_hello)

    def _lose(self, why: str) -> None:
        """Tell that all its devices are away, and hold their beams."""
        if self._lost is not None:
            return
        _log.warning("station %s is lost: %s", self.name, why)
        self._lost, self._since_ns = why, time.time_ns()
        self._tell_lost("disconnected", f'the station "{self.name}" is lost: {why}')
        with self._passed:
            self._passed.notify_all()

    def bus_changed(self) -> None:
        """Note that the connection to the bus was made, or is lost: its beams have deadlines."""
        self.holds.silence = None if self._connection.connected else self._connection.reason
        if self._connection.connected:
            self._resynchronise()

    def _find(self) -> None:
        """Take that it is there again."""
        _log.info("station %s is there", self.name)
        self._lost, self._since_ns = None, time.time_ns()
        self._soon(self._say_hello)
        self._resynchronise()

    def _comes_back(self, device_id: str) -> bool:
        """Whether a device of a lost station is one that ran."""
        found = self._figures.devices.get(device_id)
        return self._lost is not None and found is not None and found.status.state not in ENDED

    def _resynchronise(self) -> None:
        """Ask for what may be among messages that were missed."""
        self._ask_again = True
        if not self._asking:
            self._asking = True
            self._soon(self._resynchronise_until_told)

    async def _resynchronise_until_told(self) -> None:
        try:
            while self._ask_again:
                self._ask_again = False
                try:
                    reply = await self._ask("resynchronise", (self._gateway,), {})
                    if reply.error is not None:
                        raise StationNotReached(reply.error.detail)
                except StationNotReached:
                    self._ask_again = self._lost is None
                await asyncio.sleep(AGAIN_S)
        finally:
            self._asking = False

    # Messages.

    def take(self, kind: str, device: str | None, data: bytes) -> None:
        """Take a message of the bus; called in the event loop."""
        part = unpack(data)
        if part.incarnation in self._past:
            return
        self._heard_s = time.monotonic()
        if part.incarnation != self._incarnation:
            self._begin(part.incarnation)
        read = self._subjects.setdefault((kind, device), Reassembly())
        missed, messages = read.take(part)
        if self._lost is not None:
            self._find()
        if missed:
            self._messages_missed += missed
            if kind in (BATCH, PIXELS):
                self._interrupt()
            self._resynchronise()
        for message in messages:
            if kind in (BATCH, PIXELS):
                self._take_frames(kind, message)
            else:
                self._take(message)
        with self._passed:
            self._passed.notify_all()

    def _take_frames(self, kind: str, data: bytes) -> None:
        if self._backlog is not None:
            if len(self._backlog) < BACKLOG:
                self._backlog.append((kind, data))
            elif self._backlog[-1][0] != "":
                self._backlog.append(("", b""))  # something is missing from here on
            return
        self._channel = kind
        self._take(data)

    _channel = BATCH
    """By which kind of subject the message in hand has come."""

    def _take_split(self, kind: MessageKind, header: Any, end: int, data: bytes) -> None:
        if kind is MessageKind.PREPARED:
            self._take_prepared(*header)
        elif kind is MessageKind.RENEWAL:
            device_id, rows = header
            self.holds.take(device_id, [read_hold(row, self._tokens) for row in rows])
        elif kind is MessageKind.PRESENCE:
            self._take_presence(read_presence(header[0]))
        elif kind is not MessageKind.CALIBRATION:
            super()._take_split(kind, header, end, data)

    def _take_calibration(self, *header: Any) -> None:
        """Never called: between machines calibrations are ids."""

    def _take_batch(self, message: BatchMessage) -> None:
        device_id = message.device_id
        by_pixels = self._channel == PIXELS
        if not by_pixels:
            if message.holds:
                self.holds.take(device_id, message.holds[-1])
            self.streams.publish_message(message)
        device = self._devices.get(device_id)
        if device is not None and device.taps and device.wants_pixels == by_pixels:
            device.offer(message)

    def _take_presence(self, presence: Presence) -> None:
        if presence.ending:
            self._lose("the station's process has ended")
            if self._incarnation is not None:
                self._past.add(self._incarnation)
            return
        self._presence = presence
        self._check_positions(presence.positions)
        for device_id, digest in presence.configurations.items():
            if self._digests.get(device_id) != digest:
                self._digests[device_id] = digest
                self._soon(self._read_stored, device_id)

    def _check_positions(self, positions: Positions) -> None:
        """Notice that the last messages of a subject are missing, without another that tells.

        Subjects overtake one another by some milliseconds: what was there half a second ago counts.
        """
        for words, number in self._targets.items():
            kind, _, device = words.partition(".")
            read = self._subjects.get((kind, device or None))
            if kind != PIXELS and read is not None and read.number < number:
                self._messages_missed += number - read.number
                read.number = number
                self._interrupt()
                self._resynchronise()
        self._targets = positions

    async def _read_stored(self, device_id: str) -> None:
        """Read what a device uses and tracks now: it was changed, maybe by another gateway."""
        try:
            found = await self._loop.run_in_executor(self._readers, self._stored.device, device_id)
        except Exception as error:  # noqa: BLE001 - the database may be away: with the next one
            _log.warning("device %s: what it tracks is not known here: %s", device_id, error)
            self._digests.pop(device_id, None)
            return
        self._configured[device_id] = found
        if not found[1].tools:
            self.poses.remove(device_id)

    def _take_prepared(
        self, device_id: str, gateway: str, tap: int, *stored_and_masked: Any
    ) -> None:
        *stored, masked = stored_and_masked
        device = self._devices.get(device_id)
        if gateway != self._gateway or device is None or not device.has_tap(tap):
            return
        if device.wants_pixels != (self._channel == PIXELS):
            return
        ids = (stored[0], stored[1], stored[2])
        found = self._calibrations.get(ids)
        if found is None and ids != (None, None, None):
            self._backlog = deque()
            self._soon(self._read_calibration, ids, device, tap, masked)
            return
        active = replace(found or NO_ACTIVE_CALIBRATION, bad_pixels=read_bad_pixels(masked))
        device.prepare(tap, active)

    async def _read_calibration(
        self, ids: StoredIds, device: RemoteDevice, tap: int, masked: bytes
    ) -> None:
        """Read a calibration, then take the frames that have come meanwhile."""
        try:
            found = await self._loop.run_in_executor(self._readers, self._stored.calibration, ids)
            while len(self._calibrations) >= 8:
                self._calibrations.pop(next(iter(self._calibrations)))
            self._calibrations[ids] = found
            device.prepare(tap, replace(found, bad_pixels=read_bad_pixels(masked)))
        except Exception as error:  # noqa: BLE001 - asked for again
            _log.warning("calibration %s is not read now: %s", ids[0], error)
            self._interrupt()
            self._resynchronise()
        backlog, self._backlog = self._backlog, None
        while backlog:
            kind, data = backlog.popleft()
            if not kind:
                self._interrupt()
                self._resynchronise()
                continue
            self._take_frames(kind, data)
            if self._backlog is not None:  # it waits for another one
                self._backlog.extend(backlog)
                return

    def _follow_pixels(self) -> None:
        """Have the pixels of those devices whose taps want them; waits in other threads."""
        if threading.get_ident() == self._loop_thread:
            self._soon(self._subscribe_pixels)
        else:
            asyncio.run_coroutine_threadsafe(self._subscribe_pixels(), self._loop).result()

    async def _subscribe_pixels(self) -> None:
        wanted = {name for name, device in tuple(self._devices.items()) if device.wants_pixels}
        for name in wanted - self._pixels.keys():
            self._pixels[name] = None
            self._subjects.pop((PIXELS, name), None)

            def take(_subject: str, data: bytes, _reply: str, name: str = name) -> None:
                self.take(PIXELS, name, data)

            self._pixels[name] = await self._connection.subscribe(
                subject(self.name, PIXELS, name), take
            )
            self._switch(name)
        for name in self._pixels.keys() - wanted:
            one = self._pixels.pop(name)
            if one is not None:
                await self._connection.unsubscribe(one)
            self._switch(name)

    def _switch(self, device_id: str) -> None:
        device = self._devices.get(device_id)
        if device is not None:
            device.switch()
