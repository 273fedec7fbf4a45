"""PipelineRouter: each device to where it belongs, this server's own pipeline or a station."""

import asyncio
import logging
from collections.abc import Callable
from contextlib import suppress
from secrets import token_hex
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hardware.driver import DeviceDescription, Driver
from service.pipeline.active_calibration import NO_ACTIVE_CALIBRATION, ActiveCalibration
from service.pipeline.beam_hold_registry import Listener
from service.pipeline.device_session import ToolCounts
from service.pipeline.device_status import DeviceStatus
from service.pipeline.frame_batch import BeamHoldState, LatestPoses
from service.pipeline.interface import (
    Accept,
    BeamHolds,
    Pipeline,
    RunningDevice,
    StationState,
    any_device,
)
from service.pipeline.stage_latency import Stage
from service.pipeline.tap_collection import collect_readings
from service.pipeline.tracking_config import TrackingConfig
from service.station.network.connection import BusConnection, BusOptions
from service.station.network.network_pipeline import NetworkPipeline, StoredReader
from service.station.network.subjects import (
    ANY,
    BATCH,
    HOLDS,
    POSES,
    STATE,
    inbox_prefix,
    split_subject,
    subject,
)
from service.station.station_mirror import ClientStreams

_log = logging.getLogger(__name__)

_END_S: Final = 10.0


class MergedHolds:
    """The beam holds of several pipelines; see ``BeamHolds``."""

    def __init__(self, parts: Callable[[], list[BeamHolds]]) -> None:
        self._parts = parts
        self._listeners: list[tuple[Listener, list[Callable[[], None]]]] = []

    def add(self, part: BeamHolds) -> None:
        """Let all listeners know of the holds of another pipeline, too."""
        for listener, ends in self._listeners:
            ends.append(part.listen(listener))

    def listen(self, listener: Listener) -> Callable[[], None]:
        """Call with every hold now, and from now on with every change."""
        ends = [part.listen(listener) for part in self._parts()]
        entry = (listener, ends)
        self._listeners.append(entry)

        def end() -> None:
            with suppress(ValueError):
                self._listeners.remove(entry)
            for one in ends:
                one()

        return end

    def set_up(self, reference_id: str) -> None:
        """Note that a reference is being set."""
        for part in self._parts():
            part.set_up(reference_id)

    def acknowledge(self, hold_id: str) -> BeamHoldState | None:
        """End the latch of a hold and return it; None: there is no such hold."""
        for part in self._parts():
            if part.now(hold_id) is not None:
                return part.acknowledge(hold_id)
        return None

    def now(self, hold_id: str) -> BeamHoldState | None:
        """Return the state of a hold; None: there is no such hold."""
        found = (part.now(hold_id) for part in self._parts())
        return next((one for one in found if one is not None), None)

    def of_device(self, device_id: str) -> tuple[BeamHoldState, ...]:
        """Return all holds of a device, by id."""
        found = (part.of_device(device_id) for part in self._parts())
        return next((one for one in found if one), ())

    def all(self) -> dict[str, tuple[BeamHoldState, ...]]:
        """Return the holds of every device."""
        every: dict[str, tuple[BeamHoldState, ...]] = {}
        for part in self._parts():
            every |= {device_id: held for device_id, held in part.all().items() if held}
        return every


class PipelineRouter:
    """The live side of a server with a bus; made in the event loop of its clients.

    Which station a device is of is said by the database, through ``assign``, and by the stations
    themselves.

    Args:
        own: the pipeline of this server's own devices; closed with this.
        streams: takes the results for the clients.
        options: how the bus is reached.
        stored: reads the database.
    """

    def __init__(
        self, own: Pipeline, streams: ClientStreams, options: BusOptions, stored: StoredReader
    ) -> None:
        self._own = own
        self.streams = streams
        self.poses: LatestPoses = own.poses
        """The newest poses of all tools."""
        self._stored = stored
        self._gateway = f"gateway-{token_hex(6)}"
        self._loop = asyncio.get_running_loop()
        self._stations: dict[str, NetworkPipeline] = {}
        self._assigned: dict[str, str] = {}
        self.holds = MergedHolds(
            lambda: [own.holds, *(one.holds for one in tuple(self._stations.values()))]
        )
        """Whether beams are held."""
        self._connection = BusConnection(
            options, self._gateway, inbox_prefix("gateway", self._gateway), self._bus_changed
        )
        self._begun = self._loop.create_task(self._begin())
        streams.on_clients(self._clients_changed)

    async def _begin(self) -> None:
        for words in ((BATCH, ANY), (POSES, ANY), (HOLDS,), (STATE,)):
            await self._connection.subscribe(subject(ANY, *words), self._take)
        self._connection.open()

    def _take(self, name: str, data: bytes, _reply: str) -> None:
        station, kind, device = split_subject(name)
        self._station(station).take(kind, device, data)

    def _station(self, name: str) -> NetworkPipeline:
        """Return a station; called in the event loop."""
        found = self._stations.get(name)
        if found is None:
            found = self._stations[name] = NetworkPipeline(
                name, self._gateway, self.streams, self.poses, self._connection, self._stored
            )
            self.holds.add(found.holds)
        return found

    def _known_station(self, name: str) -> NetworkPipeline:
        """Return a station, from any thread but that of the event loop."""
        found = self._stations.get(name)
        if found is None:

            async def make() -> NetworkPipeline:
                return self._station(name)

            found = asyncio.run_coroutine_threadsafe(make(), self._loop).result(_END_S)
        return found

    def _bus_changed(self) -> None:
        for station in self._stations.values():
            station.bus_changed()

    def _clients_changed(self, device_id: str, _clients: int) -> None:
        station = self._station_of(device_id)
        if station is not None:
            station.clients_changed()

    def _station_of(self, device_id: str) -> NetworkPipeline | None:
        """Return the station of a device; None: it is this server's own. Never waits."""
        for station in tuple(self._stations.values()):
            if station.reached and station.knows(device_id):
                return station
        name = self._assigned.get(device_id)
        if name is not None:
            return self._stations.get(name)
        lost = (one for one in tuple(self._stations.values()) if one.knows(device_id))
        return next(lost, None)

    def _of(self, device_id: str) -> Pipeline | NetworkPipeline:
        return self._station_of(device_id) or self._own

    # Stations of devices.

    def assign(self, device_id: str, station: str | None) -> None:
        """Note which station a device is of; None: this server itself."""
        if station is None:
            self._assigned.pop(device_id, None)
        else:
            self._known_station(station)
            self._assigned[device_id] = station

    def is_far(self, device_id: str) -> bool:
        """Whether a device is of a station, as far as is known. Never waits."""
        return device_id in self._assigned or self._station_of(device_id) is not None

    def reaches(self, station: str | None) -> bool:
        """Whether a station answers now; None: this server itself."""
        known = self._stations.get(station) if station is not None else None
        return station is None or (known is not None and known.reached)

    def start_at_station(self, device_id: str) -> None:
        """Have a device's station start it as the database says; raises what that raises."""
        self._known_station(self._assigned[device_id]).start(device_id)

    def sensors_at_station(self, station: str, device_id: str, source: Any) -> list[dict[str, Any]]:
        """Return the sensors that a source has at a station's machine."""
        return self._known_station(station).sensors(device_id, source)

    # Pipeline.

    @property
    def ready(self) -> bool:
        """Whether frames of this server's own devices are processed."""
        return self._own.ready

    @property
    def busy_s(self) -> float:
        """Time spent so far on the current batch or job of its own [s]."""
        return self._own.busy_s

    @property
    def stations(self) -> tuple[StationState, ...]:
        """The processes that devices belong to."""
        far = sorted(self._stations.items())
        return (*self._own.stations, *(one.standing for _, one in far))

    def start_device(
        self,
        device_id: str,
        driver: Driver,
        active: ActiveCalibration = NO_ACTIVE_CALIBRATION,
        accept: Accept = any_device,
    ) -> DeviceDescription | None:
        """Open the driver of a device of this server and start its reader."""
        return self._own.start_device(device_id, driver, active, accept)

    def stop_device(self, device_id: str) -> None:
        """Stop the device and close its driver; nothing happens when it is not running."""
        self._of(device_id).stop_device(device_id)

    def forget_device(self, device_id: str) -> None:
        """Stop the device, drop its counters and end its streams."""
        self._of(device_id).forget_device(device_id)
        self._assigned.pop(device_id, None)

    def set_calibration(self, device_id: str, active: ActiveCalibration) -> None:
        """Switch calibration and table between two frames; nothing happens when it is not running.

        Raises:
            StationNotReached: the station of the device does not have it yet.
        """
        self._of(device_id).set_calibration(device_id, active)

    def set_tracking_config(self, device_id: str, tracked: TrackingConfig) -> None:
        """Set a device's tracking configuration: from the next batch on, or once it is started.

        Raises:
            StationNotReached: the station of the device does not have it yet.
        """
        self._of(device_id).set_tracking_config(device_id, tracked)

    def tracked(self, device_id: str) -> TrackingConfig:
        """Return a device's tracking configuration, now or once it is started."""
        return self._of(device_id).tracked(device_id)

    def refresh(self) -> None:
        """Wait until statuses and counters are those of now, where they may be older."""
        self._own.refresh()
        for station in tuple(self._stations.values()):
            station.refresh()

    def status(self, device_id: str) -> DeviceStatus:
        """Return the device's status; "stopped" for one never started."""
        station = self._station_of(device_id)
        return self._own.status(device_id) if station is None else station.status(device_id)

    def statuses(self) -> dict[str, DeviceStatus]:
        """Return the status of every device that was started, or tried to."""
        return self._all(lambda one: one.statuses())

    def latencies(self) -> dict[str, tuple[tuple[int, ...], float]]:
        """Return the latencies of batches by class, and their sum [s], by device."""
        return self._all(lambda one: one.latencies())

    def stage_latencies(self) -> dict[str, tuple[int, dict[Stage, float]]]:
        """Return frames that were timed, and their time in each stage [s], by device."""
        return self._all(lambda one: one.stage_latencies())

    def pose_counts(self) -> dict[str, dict[str, ToolCounts]]:
        """Return pose counts by device and tool, of devices that were started."""
        return self._all(lambda one: one.pose_counts())

    def describe(self, device_id: str) -> DeviceDescription | None:
        """Return the driver's description of a device; None: it was never started."""
        return self._of(device_id).describe(device_id)

    def session(self, device_id: str) -> RunningDevice:
        """Return a running device; raises DeviceNotRunning."""
        return self._of(device_id).session(device_id)

    def collect(
        self, device_id: str, frames: int, marker: int | None, timeout_s: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the readings of one marker in the next frames of a running device."""
        return collect_readings(self, device_id, frames, marker, timeout_s)

    def close(self) -> None:
        """Stop this server's devices, and let those of stations go on."""
        with suppress(RuntimeError, TimeoutError):
            asyncio.run_coroutine_threadsafe(self._end(), self._loop).result(_END_S)
        self._own.close()

    async def _end(self) -> None:
        await self._begun
        for station in self._stations.values():
            await station.end()
        await self._connection.close()

    def _all(self, of: Callable[[Any], dict[str, Any]]) -> dict[str, Any]:
        """Return what all pipelines say, by device: of a station that is there before the rest."""
        every: dict[str, Any] = {}
        stations = sorted(self._stations.values(), key=lambda one: one.reached)
        for one in (self._own, *stations):
            every |= of(one)
        return every
