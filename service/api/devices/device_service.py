"""DeviceService: changes of a device in the database and in the running pipeline, one at a time."""

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Final

from sqlalchemy import ColumnElement, select
from sqlalchemy.orm import Session

from compute.errors import InvalidParameter, LumilineError
from service.api.devices import store
from service.api.devices.driver_factory import Bars, check_names, make_driver, sensors_of
from service.api.devices.nominal_source import nominal_mismatch, same_simulation
from service.api.devices.schema import (
    Device,
    DeviceChange,
    ExternalSource,
    FusionSource,
    NewDevice,
    Sensor,
    SimulatedSource,
    Source,
    check_connected_sensors,
    check_sensors,
)
from service.api.devices.store import (
    Target,
    active,
    check_not_retired,
    lock_device,
    move_pointer,
    previous_activation,
)
from service.api.inputs import elsewhere, of_application
from service.api.preconditions import Precondition
from service.database.engine import Database
from service.database.gateway import DEVICES, Gateway
from service.database.models import CalibrationRow, DeviceRow, HoldRow
from service.pipeline.active_calibration import ActiveCalibration, ActiveRadiometric
from service.pipeline.device_status import DeviceStatus
from service.pipeline.interface import Pipeline, RemoteStations
from service.pipeline.tracking_config import TrackingConfig
from service.problems.errors import (
    ActivationConflict,
    DeviceInUse,
    DeviceWithoutDriver,
    NominalCalibrationMismatch,
    StationNotReached,
    UnknownStation,
)
from service.settings import DataFolders

_log = logging.getLogger(__name__)

_RUNS: Final = ("starting", "running", "disconnected")
"""States in which a device's sensors do not change."""


@dataclass(frozen=True)
class StoredContent:
    """Readers of what other resources store for a device.

    Args:
        active_calibration: the calibration and table that the device's pointer names.
        active_radiometric: the radiometric calibration of an id.
        tracking_config: its tools, beam holds and tracking settings.
    """

    active_calibration: Callable[[Session, str], ActiveCalibration]
    active_radiometric: Callable[[Session, str], ActiveRadiometric]
    tracking_config: Callable[[Session, DeviceRow], TrackingConfig]


class DeviceService:
    """Starts, stops and recalibrates devices so that the database and the live side agree.

    Args:
        database: the database.
        live: the live side.
        folders: where recordings and profiles are.
        stored: reads what other resources store for a device.
        gateway: this server among those on the database; None: it is alone.
        own: the station that this process is; None: a server; empty: one without devices of its
            own.
        stations: those on other machines; None: there are none.
    """

    def __init__(
        self,
        database: Database,
        live: Pipeline,
        folders: DataFolders,
        stored: StoredContent,
        gateway: Gateway | None = None,
        own: str | None = None,
        stations: RemoteStations | None = None,
    ) -> None:
        self._database = database
        self._gateway = Gateway() if gateway is None else gateway
        self._stored = stored
        self._live = live
        self._folders = folders
        self._own = own
        self._stations = stations
        self._locks: dict[str, threading.Lock] = {}
        self._guard = threading.Lock()

    @contextmanager
    def _exclusive(self, device_id: str) -> Iterator[None]:
        """Keep other changes of this device waiting; other devices go on."""
        with self._guard:
            lock = self._locks.setdefault(device_id, threading.Lock())
        with lock:
            yield

    def check_here(self, device_id: str) -> None:
        """Raise DeviceElsewhere where another gateway has the device; all have a station's."""
        if self._gateway.holds(DEVICES):
            return
        if self._stations is not None:
            if self._stations.is_far(device_id):
                return
            with self._database.read() as session:
                station = store.get_device(session, device_id).station
            if station is not None:
                self._stations.assign(device_id, station)
                return
        raise elsewhere(self._gateway, device_id)

    def _check_openable(self, device_id: str, source: Source, station: str | None) -> None:
        """Raise DeviceElsewhere where only another gateway can open a source."""
        anywhere = isinstance(source, ExternalSource | FusionSource | SimulatedSource)
        if station is None and not anywhere and not self._gateway.holds(DEVICES):
            raise elsewhere(self._gateway, device_id)

    def create(self, request: NewDevice) -> Device:
        """Create a device; its sensors come from its driver where it has one.

        Raises:
            DeviceExists, DeviceElsewhere, or what the driver raises when it is opened.
        """
        self._check_openable(request.id, request.source, request.station)
        sensors = self._sensors_of(request.id, request.source, request.station)
        with self._exclusive(request.id):
            with self._database.write() as session:
                created = store.document(session, store.add_device(session, request, sensors))
            self._assign(request.id, request.station)
            return created

    def _bars(self, source: Source, station: str | None) -> Bars:
        """Return the sensors of the devices that a fused one of a station is made of.

        Raises:
            UnknownDevice: one of them is not there.
            InvalidParameter: one of them is fused itself, or of another station.
        """
        if not isinstance(source, FusionSource):
            return {}
        with self._database.read() as session:
            rows = [store.get_device(session, bar) for bar in source.bars]
            fused = [row.id for row in rows if isinstance(store.source_of(row), FusionSource)]
            if fused:
                raise InvalidParameter(
                    f'"{fused[0]}" is fused itself; name the bars that it is made of', bars=fused
                )
            far = [row for row in rows if row.station != station]
            if far:
                raise InvalidParameter(
                    f'"{far[0].id}" is of {_where(far[0].station)}; a fused device is of the same '
                    f"station as its bars, and this one is of {_where(station)}",
                    bars=[row.id for row in far],
                )
            return {row.id: store.sensors_of_row(row) for row in rows}

    def change(self, device_id: str, change: DeviceChange, expected: Precondition) -> Device:
        """Change a device; a new source works from the device's next start.

        Raises:
            UnknownDevice, PreconditionFailed, DeviceInUse, DeviceRunning, or what the driver
            raises when it is opened.
        """
        with self._database.read() as session:
            station = store.get_device(session, device_id).station
        given = change.model_fields_set
        target = change.station if "station" in given else station
        sensors = None
        if "source" in given or target != station:
            self.check_here(device_id)  # which knows whether it runs
        if "source" in given:
            sensors = self._sensors_of(device_id, change.source, target)
        else:
            self._check_station(device_id, target)
        with self._exclusive(device_id):
            self._assign(device_id, station)
            # Before the transaction: the live side may be busy starting another device.
            # Of a lost station it is not known; it forgets the device once it is back.
            reached = self._stations is None or self._stations.reaches(station)
            running = reached and self._live.status(device_id).state in _RUNS
            with self._database.write() as session:
                row = store.get_device(session, device_id, lock=True)
                expected.check(store.document(session, row))
                before = store.source_of(row)
                row = store.change_device(session, device_id, change, sensors, running=running)
                if sensors is not None and not same_simulation(before, change.source):
                    self._refuse_if_nominal(session, device_id, change.source)
                changed = store.document(session, row)
                tracked = self._stored.tracking_config(session, row)
                retracked = "tracking" in given or target != station
                if retracked:
                    number = self._announce(session, device_id, target)
            if target != station:
                self._live.forget_device(device_id)
                self._assign(device_id, target)
            if retracked:
                self._apply_tracking_config(device_id, tracked, number)
            return changed

    def _sensors_of(self, device_id: str, source: Source, station: str | None) -> list[Sensor]:
        """Return the sensors of a source, which a station's own machine has to be asked for."""
        self._check_station(device_id, station)
        known = isinstance(source, ExternalSource | FusionSource)
        near = station is None or station == self._own or known
        if near or self._stations is None or station is None:
            return sensors_of(device_id, source, self._folders, self._bars(source, station))
        plain = source.model_dump(mode="json")
        found = self._stations.sensors_at_station(station, device_id, plain)
        return check_names([Sensor(**one) for one in found])

    def _check_station(self, device_id: str, station: str | None) -> None:
        if station != self._own and self._stations is None:
            raise UnknownStation(
                f'device "{device_id}" cannot be of the station "{station}": this server reaches '
                "none; give it a bus_url, or leave the station out",
                device_id=device_id,
                station=station,
            )

    def _assign(self, device_id: str, station: str | None) -> None:
        """Let the live side know where a device is."""
        if self._stations is not None:
            self._stations.assign(device_id, station)

    def _refuse_if_nominal(self, session: Session, device_id: str, source: Source) -> None:
        """Raise DeviceInUse where the active calibration is nominal and not of a new source.

        As of calibrations of other sensors: a pointer that the server took away by itself would end
        poses and beam holds.
        """
        found = self._stored.active_calibration(session, device_id)
        why = nominal_mismatch(found.calibration_content, source, self._folders.profiles)
        if why is not None:
            raise DeviceInUse(
                f'device "{device_id}" uses the nominal calibration "{found.calibration_id}": '
                f"{why}; activate that one first, or create a device of its own for this source",
                device_id=device_id,
                calibration_id=found.calibration_id,
            )

    def delete(self, device_id: str, expected: Precondition, *, cascade: bool) -> None:
        """Delete a device and stop it; raises UnknownDevice, DeviceInUse, PreconditionFailed."""
        with self._exclusive(device_id):
            with self._database.write() as session:
                row = store.get_device(session, device_id, lock=True)
                expected.check(store.document(session, row))
                station = row.station
                self._assign(device_id, station)
                store.delete_device(session, device_id, cascade=cascade)
                number = self._announce(session, device_id, station)
            if number is None:
                self._live.forget_device(device_id)
            else:
                self._wait_followed(device_id, number)

    def start(self, device_id: str) -> DeviceStatus:
        """Start a device with its active calibration, again if it is running.

        Raises:
            UnknownDevice, DeviceWithoutDriver, SensorsChanged, DeviceElsewhere, or what the driver
            raises when it is opened. A device that is unplugged is no error: it is waited for.
        """
        with self._exclusive(device_id):
            with self._database.read() as session:
                row = store.get_device(session, device_id)
                source, station = store.source_of(row), row.station
                if station is None:
                    self.check_here(device_id)
                found = self._active(session, device_id)
                stored = store.sensors_of_row(row)
                tracked = self._stored.tracking_config(session, row)
            if station != self._own and not isinstance(source, ExternalSource):
                self._start_at_station(device_id, station)
                return self._live.status(device_id)
            self._live.set_tracking_config(device_id, tracked)
            driver = make_driver(device_id, source, self._folders, self._bars(source, station))
            self._live.start_device(
                device_id, driver, found, partial(check_connected_sensors, device_id, stored)
            )
            return self._live.status(device_id)

    def _start_at_station(self, device_id: str, station: str | None) -> None:
        if self._stations is None or station is None:
            advice = (
                "this server has no devices of its own (LUMILINE_STATION=none); give the device a "
                "station"
                if station is None
                else f'it is of the station "{station}", which is not reached from here'
            )
            raise DeviceWithoutDriver(
                f'device "{device_id}" cannot be started: {advice}', device_id=device_id
            )
        self._stations.assign(device_id, station)
        self._stations.start_at_station(device_id)

    def stop(self, device_id: str) -> DeviceStatus:
        """Stop a device, also while the database does not answer.

        Raises:
            UnknownDevice, DeviceElsewhere.
        """
        with self._exclusive(device_id):
            self.check_here(device_id)
            if self._live.status(device_id).state == "stopped":
                with self._database.read() as session:
                    store.get_device(session, device_id)
            self._live.stop_device(device_id)
            return self._live.status(device_id)

    def stored(self, device_id: str) -> tuple[str | None, ActiveCalibration, TrackingConfig]:
        """Return a device's station, what it uses and what it tracks; raises UnknownDevice."""
        with self._database.read() as session:
            row = store.get_device(session, device_id)
            found = self._active(session, device_id)
            return row.station, found, self._stored.tracking_config(session, row)

    def status(self, device_id: str) -> DeviceStatus:
        """Return what a device is doing; raises UnknownDevice, DeviceElsewhere."""
        with self._database.read() as session:
            store.get_device(session, device_id)
        self.check_here(device_id)
        self._live.refresh()
        return self._live.status(device_id)

    @contextmanager
    def pointer_move(
        self, device_id: str, reached: Callable[[Target], bool], expected: str | None = None
    ) -> Iterator[Session]:
        """Yield a transaction that moves the active pointer; after its commit the pipeline follows.

        What is refused is refused before the commit. After it nothing is: where the running device
        cannot take the calibration it keeps its own, until its next start.

        Args:
            device_id: the device.
            reached: whether the pointer is already where the request wants it.
            expected: the calibration that the client believes to be active; None: it did not say.

        Raises:
            SensorsChanged: the device has other sensors than the calibration.
            NominalCalibrationMismatch: it is nominal, and not of the device's source.
            ActivationConflict: another calibration is active than expected, or another move came
                first.
        """
        with self._database.read() as session:
            last_move = _last_move(session, device_id)
        with self._exclusive(device_id):
            with self._database.write() as session:
                lock_device(session, device_id)
                _check_precondition(session, device_id, last_move, expected, reached)
                yield session
                found = self._active(session, device_id)
                if found.calibration is not None:
                    device = store.get_device(session, device_id)
                    check_sensors(device_id, store.sensors_of_row(device), found.calibration.models)
                    self._check_nominal(found, device)
                number = self._announce(session, device_id, _station_of(session, device_id))
            self._activate(device_id, found, number)

    def _check_nominal(self, found: ActiveCalibration, device: DeviceRow) -> None:
        """Raise NominalCalibrationMismatch where a calibration is not of the device's source."""
        if (found.calibration_content or {}).get("provenance") != "nominal":
            return
        source = store.source_of(device)
        why = nominal_mismatch(found.calibration_content, source, self._folders.profiles)
        if why is not None:
            raise NominalCalibrationMismatch(
                f'calibration "{found.calibration_id}" is nominal: {why}',
                device_id=device.id,
                calibration_id=found.calibration_id,
            )

    @contextmanager
    def radiometric_move(self, device_id: str) -> Iterator[Session]:
        """Yield a transaction that changes the radiometric calibration that a device uses.

        The device is locked. After the commit the pipeline follows, as of ``pointer_move``.

        Raises:
            UnknownDevice.
        """
        with self._exclusive(device_id):
            with self._database.write() as session:
                store.get_device(session, device_id, lock=True)
                yield session
                found = self._active(session, device_id)
                number = self._announce(session, device_id, _station_of(session, device_id))
            self._activate(device_id, found, number)

    def _active(self, session: Session, device_id: str) -> ActiveCalibration:
        """Return what a device uses: calibration, correction table, radiometric calibration."""
        found = self._stored.active_calibration(session, device_id)
        radiometric_id = store.active_radiometric_id(session, device_id)
        if radiometric_id is None:
            return found
        return replace(found, radiometric=self._stored.active_radiometric(session, radiometric_id))

    def _activate(
        self, device_id: str, found: ActiveCalibration, elsewhere: int | None = None
    ) -> None:
        """Let the running device use a calibration; ``elsewhere``: number of the change there."""
        if elsewhere is not None:
            self._wait_followed(device_id, elsewhere)
            return
        try:
            self._live.set_calibration(device_id, found)
        except StationNotReached:
            raise  # it says that it is stored
        except Exception:  # noqa: BLE001 - committed: an error would say that it was not
            _log.exception("device %s does not use %s yet", device_id, found.calibration_id)

    def roll_back(self, device_id: str, expected: str | None = None) -> Device:
        """Go back to what the device used before its last activation; again: further back.

        Raises:
            UnknownDevice, NothingToRollBack, CalibrationRetired, SensorsChanged.
            ActivationConflict: another calibration is active than expected, or another move came
                first.
        """
        with self._database.read() as session:
            store.get_device(session, device_id)
        with self.pointer_move(device_id, lambda _: False, expected) as session:
            target = previous_activation(session, device_id)
            check_not_retired(session.get_one(CalibrationRow, target.calibration_id))
            move_pointer(session, device_id, target)
            return store.document(session, store.get_device(session, device_id))

    @contextmanager
    def tools_change(self, device_id: str) -> Iterator[Session]:
        """Yield a transaction that changes a device's tools; after its commit the pipeline follows.

        Raises:
            UnknownDevice.
        """
        with self._exclusive(device_id):
            with self._database.write() as session:
                device = store.get_device(session, device_id, lock=True)
                yield session
                tracked = self._stored.tracking_config(session, device)
                number = self._announce(session, device_id, device.station)
            self._apply_tracking_config(device_id, tracked, number)

    def _apply_tracking_config(
        self, device_id: str, tracked: TrackingConfig, elsewhere: int | None = None
    ) -> None:
        if elsewhere is not None:
            self._wait_followed(device_id, elsewhere)
            return
        try:
            self._live.set_tracking_config(device_id, tracked)
        except StationNotReached:
            raise  # it says that it is stored
        except Exception:  # noqa: BLE001 - committed: an error would say that it was not
            _log.exception("device %s does not follow its tools as stored yet", device_id)

    def _announce(self, session: Session, device_id: str, station: str | None) -> int | None:
        """Announce a change of a device to the gateway that has it; a station is told by the bus.

        Returns:
            As of ``Gateway.announce_change``; None for a device of a station.
        """
        return None if station is not None else self._gateway.announce_change(session, device_id)

    def _wait_followed(self, device_id: str, number: int) -> None:
        """Wait until the gateway with the devices does as was committed, which happens anyway."""
        try:
            if not self._gateway.wait_followed(device_id, number):
                _log.warning("device %s does not follow its change %d yet", device_id, number)
        except LumilineError as error:
            _log.warning("device %s: its change %d: %s", device_id, number, error.detail)

    def follow(self, device_id: str) -> None:
        """Let a device use what the database says, which other gateways have changed."""
        with self._exclusive(device_id):
            with self._database.read() as session:
                row = session.get(DeviceRow, device_id)
                if row is not None:
                    found = self._active(session, device_id)
                    tracked = self._stored.tracking_config(session, row)
                    station = row.station
            if row is None:
                self._live.forget_device(device_id)
                return
            if station != self._own:
                self._assign(device_id, station)
                return
            self._activate(device_id, found)
            self._apply_tracking_config(device_id, tracked)

    def give_up(self) -> None:
        """Stop all devices and end their streams: another gateway has them now."""
        for device_id in {*self._live.statuses(), *self._live.holds.all()}:
            if self._stations is None or not self._stations.is_far(device_id):
                with self._exclusive(device_id):
                    self._live.forget_device(device_id)

    def _monitor_beam_holds(self) -> None:
        """Let the live side know the beam holds of devices that do not run yet."""
        with self._database.read() as session:
            having = select(DeviceRow).where(
                DeviceRow.id.in_(select(HoldRow.device_id)), _is_of(self._own)
            )
            rows = session.scalars(having.order_by(DeviceRow.id)).all()
            known = [(row.id, self._stored.tracking_config(session, row)) for row in rows]
        for device_id, tracked in known:
            self._apply_tracking_config(device_id, tracked)

    def assign_stations(self) -> None:
        """Let the live side know where all devices are."""
        with self._database.read() as session:
            stations = session.execute(select(DeviceRow.id, DeviceRow.station)).all()
        for device_id, station in stations:
            self._assign(device_id, station)

    def autostart(self, *also: str) -> None:
        """Start all devices that say so, and these; one that fails keeps no other waiting."""
        self._monitor_beam_holds()
        with self._database.read() as session:
            wanted = session.scalars(
                select(DeviceRow.id)
                .where(DeviceRow.autostart, _is_of(self._own))
                .order_by(DeviceRow.id)
            ).all()
        for device_id in dict.fromkeys((*wanted, *also)):
            try:
                self.start(device_id)
            except LumilineError as error:
                _log.error("device %s was not started: %s", device_id, error.detail)
            except Exception:  # noqa: BLE001 - a driver's fault must not keep the server down
                _log.exception("device %s was not started", device_id)


def _is_of(station: str | None) -> ColumnElement[bool]:
    """Return the condition that a device is of a station; None: of the server."""
    return DeviceRow.station.is_(None) if station is None else DeviceRow.station == station


def _check_precondition(
    session: Session,
    device_id: str,
    last_move: int | None,
    expected: str | None,
    reached: Callable[[Target], bool],
) -> None:
    """Check the precondition of an activation (optimistic concurrency); the device is locked.

    Of requests at the same moment one wins, and the others decide anew. Where the device is already
    as the request wants it, nothing is in conflict: it may be sent again.

    Args:
        session: the session.
        device_id: the device.
        last_move: the newest move of its history when the request came.
        expected: the calibration that the client believes to be active; None: it did not say.
        reached: whether the device is as the request wants it.

    Raises:
        ActivationConflict: another move came first.
    """
    now = active(session, device_id)
    if now is not None and reached(now):
        return
    shown = "none" if now is None else f'"{now.calibration_id}"'
    if now is not None and now.table_id is not None:
        shown += f' with table "{now.table_id}"'
    if expected is not None and (now is None or now.calibration_id != expected):
        raise ActivationConflict(
            f'device "{device_id}" uses the calibration {shown}, not "{expected}" as '
            "the request expects; look at its activations, and ask again",
            device_id=device_id,
            expected=expected,
            active=None if now is None else now.calibration_id,
        )
    if _last_move(session, device_id) != last_move:
        raise ActivationConflict(
            f'another request was first, and device "{device_id}" uses the calibration '
            f"{shown} now; look at its activations, and ask again",
            device_id=device_id,
            active=None if now is None else now.calibration_id,
        )


def _station_of(session: Session, device_id: str) -> str | None:
    return store.get_device(session, device_id).station


def _where(station: str | None) -> str:
    return "the server itself" if station is None else f'the station "{station}"'


def _last_move(session: Session, device_id: str) -> int | None:
    newest = store.latest_activation(session, device_id)
    return None if newest is None else newest.id


DeviceServiceDep = Annotated[DeviceService, of_application("device_service")]
