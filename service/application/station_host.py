"""StationHost: the process of `lumiline station`, which owns the devices of one machine.

It starts the same process as `lumiline serve` does, and is its only client: what comes by its
shared memory it passes on to the bus, and what gateways ask for over the bus it does. What a device
is to be it reads from the database. Without database or bus its devices go on as they are.
"""

import asyncio
import logging
import platform
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from secrets import token_hex
from typing import Any, Final

from pydantic import TypeAdapter, ValidationError
from sqlalchemy.exc import SQLAlchemyError

from compute.errors import InvalidParameter, LumilineError
from service.api.beam_holds.monitor_config import tracking_config_of
from service.api.correction_tables.store import active_calibration
from service.api.devices.device_service import DeviceService, StoredContent
from service.api.devices.driver_factory import sensors_of
from service.api.devices.profiles import find_profile
from service.api.devices.schema import Source
from service.api.devices.station_devices import StationDevices
from service.api.radiometric_calibrations.store import active_radiometric
from service.application.far_stations import bus_options
from service.database.engine import Database
from service.database.migration import newest_revision, revision_of
from service.problems.errors import DeviceNotRunning, NotReady, StationFailed
from service.settings import Settings
from service.station.bus_messages import presence_message
from service.station.network.connection import BusConnection
from service.station.network.messages import (
    BadRequest,
    Positions,
    Presence,
    Reply,
    pack_presence,
    pack_reply,
    pack_request,
    read_request,
)
from service.station.network.outbox import Outbox
from service.station.network.relay import FORGET_S, Gateway, Relay, RelayingPipeline, RelayTap
from service.station.network.search_models import plain_search_model
from service.station.network.subjects import BATCH, CALL, STATE, inbox_prefix, subject
from service.station.station_starter import StationStarter

_log = logging.getLogger(__name__)

PRESENCE_S: Final = 0.5
"""Time between two messages that say that the station is there."""
RECONCILE_S: Final = 5.0
"""Time between two looks whether the database says something else."""
_CALLS: Final = 8
"""Calls at a time: the start of a device may take seconds, and keeps no other waiting."""
_SOURCE: TypeAdapter[Source] = TypeAdapter(Source)


class StationHost:
    """Runs a station; all of it in one event loop, but for what waits.

    Args:
        settings: with ``station_name`` and ``bus_url``.
        starter: starts the process that owns the devices; stays the caller's.
    """

    def __init__(self, settings: Settings, starter: StationStarter) -> None:
        assert settings.station_name is not None
        self._settings = settings
        self._name = settings.station_name
        self._starter = starter
        self._database = Database(settings.effective_database_url, query_timeout=True)
        self._gateways: dict[str, Gateway] = {}
        self._pool = ThreadPoolExecutor(_CALLS, thread_name_prefix="call")
        self._devices: StationDevices | None = None
        self._complaint: str | None = "the database was not read yet"
        self._began_ns = time.time_ns()
        self._tasks: set[asyncio.Task[None]] = set()

    async def run(self, stop: asyncio.Event) -> None:
        """Be the station until ``stop`` is set."""
        loop = asyncio.get_running_loop()
        who, process = f"station-{self._name}", token_hex(6)
        self._connection = BusConnection(
            bus_options(self._settings), who, inbox_prefix(who, process), self._bus_changed
        )
        self._loop = loop
        self._outbox = Outbox(
            self._name, token_hex(8), self._connection, self._settings.bus_delay_s
        )
        self._relay = Relay(self._outbox)
        settings = self._settings
        self._pipeline = RelayingPipeline(
            self._relay,
            self._starter,
            settings.compute_device,
            partial(find_profile, profiles_dir=settings.folders.profiles),
            settings.station_priority,
            settings.station_cores,
        )
        self._relay.figures = self._pipeline.far_figures
        self._pipeline.holds.listen(self._relay.put_hold)
        self._connection.open()
        self._soon(self._become_the_only_one())
        self._soon(self._keep_present())
        self._soon(self._follow_database())
        try:
            await stop.wait()
        finally:
            for task in tuple(self._tasks):
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)
            await loop.run_in_executor(None, self._pipeline.close)
            self._say_presence(ending=True)
            await self._outbox.close()
            await self._connection.close()
            self._pool.shutdown(wait=False, cancel_futures=True)
            await loop.run_in_executor(None, self._database.close)

    def _soon(self, work: Any) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def _bus_changed(self) -> None:
        if self._connection.connected:
            self._pipeline.tell_again()

    # What it does by itself.

    async def _become_the_only_one(self) -> None:
        """Take calls once no other station of this name answers any more."""
        while True:
            if self._connection.connected:
                try:
                    hello = pack_request(("", {}, []), {})
                    where = subject(self._name, CALL, "hello")
                    await self._connection.request(where, hello, 1.0)
                except NotReady:
                    break
                _log.critical(
                    'another station "%s" is on the bus; give this one another name, or end that '
                    "one: it gets no calls until then",
                    self._name,
                )
                await asyncio.sleep(2.0)
            await asyncio.sleep(0.05)
        await self._connection.subscribe(subject(self._name, CALL, "*"), self._take_call)

    async def _keep_present(self) -> None:
        while True:
            self._relay.publish_figures()
            self._say_presence()
            self._forget_gateways()
            await asyncio.sleep(PRESENCE_S)

    def _say_presence(self, *, ending: bool = False) -> None:
        pipeline, devices = self._pipeline, self._devices
        presence = Presence(
            platform.node(),
            pipeline.process_id,
            pipeline.restarts,
            pipeline.messages_missed + self._outbox.dropped,
            self._began_ns,
            self._outbox.positions,
            devices.digests if devices is not None else {},
            self._complaint,
            ending,
        )
        self._outbox.put((STATE,), presence_message(pack_presence(presence)))

    async def _follow_database(self) -> None:
        """Take over its devices once the database is there, and what changes from then on."""
        loop = asyncio.get_running_loop()
        while True:
            try:
                await loop.run_in_executor(None, self._read_database)
                if self._complaint is not None:
                    _log.info("the database answers")
                self._complaint = None
            except (SQLAlchemyError, LumilineError, OSError) as error:
                # Not the error's text: it may hold the URL with the password.
                why = error.detail if isinstance(error, LumilineError) else type(error).__name__
                complaint = f"the database does not answer ({why}); its devices go on as they are"
                if complaint != self._complaint:
                    _log.error("%s", complaint)
                self._complaint = complaint
            await asyncio.sleep(1.0 if self._devices is None else RECONCILE_S)

    def _read_database(self) -> None:
        if self._devices is not None:
            self._devices.reconcile()
            return
        with self._database.engine.connect() as connection:
            revision = revision_of(connection)
        if revision != newest_revision():
            raise NotReady(
                f"it is of revision {revision}, this version of the station is of "
                f"{newest_revision()}; a server of this version brings it up to date",
                part="database",
            )
        service = DeviceService(
            self._database,
            self._pipeline,
            self._settings.folders,
            StoredContent(active_calibration, active_radiometric, tracking_config_of),
            own=self._name,
        )
        devices = StationDevices(self._name, self._database, self._pipeline, service)
        devices.begin()
        self._devices = devices

    def _forget_gateways(self) -> None:
        """End what gateways wanted that ask no more."""
        oldest_s = time.monotonic() - FORGET_S
        for name, gateway in tuple(self._gateways.items()):
            if gateway.asked_s < oldest_s:
                del self._gateways[name]
                self._keep_taps(gateway, frozenset())
                self._count_clients()

    # Calls.

    def _take_call(self, name: str, data: bytes, reply: str) -> None:
        method = name.rpartition(".")[2]
        if method == "hello":
            result, error = self._guarded(partial(self._hello, data))
            self._answer(reply, result, error, {})
        else:
            self._soon(self._do(method, data, reply))

    async def _do(self, method: str, data: bytes, reply: str) -> None:
        loop = asyncio.get_running_loop()
        call = partial(self._call, method, data)
        result, error = await loop.run_in_executor(self._pool, self._guarded, call)
        self._relay.publish_figures()
        self._outbox.flush_all()
        positions = self._outbox.positions
        if method != "attach":
            positions = {k: v for k, v in positions.items() if not k.startswith(f"{BATCH}.")}
        self._answer(reply, result, error, positions)

    def _guarded(self, call: Callable[[], Any]) -> tuple[Any, LumilineError | None]:
        try:
            return call(), None
        except LumilineError as error:
            return None, error
        except SQLAlchemyError as error:
            kind = type(error).__name__
            text = f'the database of the station "{self._name}" does not answer ({kind})'
            return None, NotReady(f"{text}; try again", part="database")
        except Exception as error:  # noqa: BLE001 - the gateway gets it
            _log.exception("a call of a gateway failed")
            return None, StationFailed(f"{type(error).__name__}: {error}", station=self._name)

    def _answer(
        self, reply: str, result: Any, error: LumilineError | None, positions: Positions
    ) -> None:
        if reply:
            answer = Reply(result, error, self._outbox.incarnation, positions, time.monotonic())
            self._soon(self._connection.publish(reply, pack_reply(answer)))

    def _call(self, method: str, data: bytes) -> Any:
        """Do what a gateway asks for; called in a thread."""
        args, members = read_request(data)
        act = _METHODS.get(method)
        if act is None:
            raise BadRequest(f"a station has no {method}; the versions are different ones")
        return act(self, *args, **members)

    def _stored(self) -> StationDevices:
        if self._devices is None:
            raise NotReady(
                f'the station "{self._name}" has not read its devices yet: {self._complaint}',
                part="database",
            )
        return self._devices

    def _start(self, device_id: str) -> None:
        self._stored().start(device_id)

    def _stop(self, device_id: str) -> None:
        self._pipeline.stop_device(device_id)

    def _apply(self, device_id: str) -> None:
        self._stored().apply(device_id)

    def _forget(self, device_id: str) -> None:
        self._stored().forget(device_id)

    def _sensors(self, device_id: str, source: Any) -> list[dict[str, Any]]:
        try:
            described = _SOURCE.validate_python(source)
        except ValidationError as error:
            raise InvalidParameter(f"the station does not know this source: {error}") from error
        found = sensors_of(device_id, described, self._settings.folders, bars={})
        return [dict(vars(one)) for one in found]

    def _acknowledge(self, hold_id: str) -> bool:
        return self._pipeline.holds.acknowledge(hold_id) is not None

    def _set_up(self, reference_id: str) -> None:
        self._pipeline.holds.set_up(reference_id)

    def _refresh(self) -> None:
        self._pipeline.refresh()

    def _last_sequence(self, device_id: str) -> int:
        return self._pipeline.session(device_id).last_sequence

    def _search_model(self, device_id: str) -> Any:
        return plain_search_model(self._pipeline.session(device_id).search_model)

    def _attach(
        self,
        device_id: str,
        generation: int,
        number: int,
        *,
        sampled: bool,
        pixels: bool,
        gateway: str,
    ) -> None:
        device = self._pipeline.far_session(device_id, generation)
        if device is None:
            raise DeviceNotRunning(
                f'device "{device_id}" was started again meanwhile; try again', device_id=device_id
            )
        tap = RelayTap(self._relay, device_id, gateway, number, wants_pixels=pixels)
        known = self._gateways.setdefault(gateway, Gateway(time.monotonic()))
        known.taps[number] = device, tap
        self._relay.pixels[device_id] += int(pixels)
        device.attach(tap, sampled=sampled)

    def _resynchronise(self, gateway: str) -> None:
        """Say everything again, to all; and to this gateway's taps what batches are made with."""
        self._loop_call(self._tell_again, gateway)

    def _tell_again(self, gateway: str) -> None:
        self._pipeline.tell_again()
        for _, tap in self._taps_of(gateway):
            tap.repeat()

    def _taps_of(self, gateway: str) -> list[tuple[Any, RelayTap]]:
        known = self._gateways.get(gateway)
        return [] if known is None else list(known.taps.values())

    def _loop_call(self, act: Callable[..., Any], *args: Any) -> None:
        async def call() -> None:
            act(*args)

        asyncio.run_coroutine_threadsafe(call(), self._loop).result(PRESENCE_S * 10)

    def _hello(self, data: bytes) -> None:
        """Take what a gateway wants, once a second; called in the event loop."""
        (name, clients, taps), _ = read_request(data)
        if not name:
            return
        gateway = self._gateways.setdefault(name, Gateway(time.monotonic()))
        gateway.asked_s, gateway.clients = time.monotonic(), dict(clients)
        self._keep_taps(gateway, frozenset(taps))
        self._count_clients()

    def _keep_taps(self, gateway: Gateway, kept: frozenset[int]) -> None:
        for number in gateway.taps.keys() - kept:
            device, tap = gateway.taps.pop(number)
            self._relay.pixels[device.device_id] -= int(tap.wants_pixels)
            device.detach(tap)

    def _count_clients(self) -> None:
        counts: Counter[str] = Counter()
        for gateway in self._gateways.values():
            counts.update(gateway.clients)
        self._relay.set_clients(counts)


_METHODS: Final[dict[str, Callable[..., Any]]] = {
    "start": StationHost._start,
    "stop": StationHost._stop,
    "apply": StationHost._apply,
    "forget": StationHost._forget,
    "sensors": StationHost._sensors,
    "acknowledge": StationHost._acknowledge,
    "set_up": StationHost._set_up,
    "refresh": StationHost._refresh,
    "last_sequence": StationHost._last_sequence,
    "search_model": StationHost._search_model,
    "attach": StationHost._attach,
    "resynchronise": StationHost._resynchronise,
}
"""What gateways may ask for, by the word of its subject."""


def run_station(settings: Settings, starter: StationStarter) -> None:
    """Be a station until a signal comes."""
    import signal

    async def run() -> None:
        stop = asyncio.Event()
        loop = asyncio.get_running_loop()
        for name in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            with suppress(NotImplementedError, ValueError):
                loop.add_signal_handler(name, stop.set)
        _log.info('station "%s": bus %s', settings.station_name, bus_options(settings).shown)
        await StationHost(settings, starter).run(stop)
        _log.info("stopped")

    asyncio.run(run())
