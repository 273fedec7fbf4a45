"""What needs the database and the running devices together, one change of a device at a time."""

import logging
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Final

from sqlalchemy import select
from sqlalchemy.orm import Session

from compute.errors import LumilineError
from hardware.driver import DeviceDescription
from service.api.calibrations import store as calibrations
from service.api.calibrations.activation import (
    active,
    lock_device,
    move_pointer,
    previous_activation,
)
from service.api.calibrations.activation_precondition import (
    ActivationPrecondition,
    IsReached,
    activation_precondition,
    check_activation_precondition,
)
from service.api.calibrations.calibration_content import result_of
from service.api.calibrations.schema import CalibrationSummary
from service.api.calibrations.sensor_check import check_sensors, listed, sensors_match
from service.api.correction_tables import store as tables
from service.api.correction_tables.schema import CorrectionTableDocument
from service.api.devices import store
from service.api.devices.driver_factory import make_driver, sensors_of
from service.api.devices.schema import Device, DeviceChange, NewDevice
from service.api.devices.sensor import Sensor
from service.api.tools.tracking_config import tracking_config_of
from service.database.engine import Database
from service.database.models import DeviceRow, HoldRow
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.device_session import DeviceStatus
from service.pipeline.pipeline_manager import Accept, PipelineManager
from service.pipeline.tracking_config import TrackingConfig
from service.problems.errors import SensorsChanged
from service.settings import DataFolders

_log = logging.getLogger(__name__)

_RUNS: Final = ("starting", "running", "disconnected")
"""States in which a device's sensors do not change."""


class DeviceService:
    """Starts, stops and recalibrates devices so that the database and the live side agree."""

    def __init__(self, database: Database, live: PipelineManager, folders: DataFolders) -> None:
        self._database = database
        self._live = live
        self._folders = folders
        self._locks: dict[str, threading.Lock] = {}
        self._guard = threading.Lock()

    @contextmanager
    def _exclusive(self, device_id: str) -> Iterator[None]:
        """Keep other changes of this device waiting; other devices go on."""
        with self._guard:
            lock = self._locks.setdefault(device_id, threading.Lock())
        with lock:
            yield

    def create(self, request: NewDevice) -> Device:
        """Create a device; its sensors come from its driver where it has one.

        Raises:
            DeviceExists, or what the driver raises when it is opened.
        """
        sensors = sensors_of(request.id, request.source, self._folders)
        with self._exclusive(request.id), self._database.write() as session:
            return store.document(session, store.add_device(session, request, sensors))

    def change(self, device_id: str, change: DeviceChange) -> Device:
        """Change a device; a new source works from the device's next start.

        Raises:
            UnknownDevice, DeviceInUse, DeviceRunning, or what the driver raises when it is opened.
        """
        with self._database.read() as session:
            store.get_device(session, device_id)
        sensors = None
        if "source" in change.model_fields_set:
            sensors = sensors_of(device_id, change.source, self._folders)
        with self._exclusive(device_id):
            # Before the transaction: the live side may be busy starting another device.
            running = self._live.status(device_id).state in _RUNS
            with self._database.write() as session:
                row = store.change_device(session, device_id, change, sensors, running=running)
                changed = store.document(session, row)
                tracked = tracking_config_of(session, row)
            if "tracking" in change.model_fields_set:
                self._follow(device_id, tracked)
            return changed

    def delete(self, device_id: str, *, cascade: bool) -> None:
        """Delete a device and stop it; raises UnknownDevice, DeviceInUse."""
        with self._exclusive(device_id):
            with self._database.write() as session:
                store.delete_device(session, device_id, cascade=cascade)
            self._live.forget_device(device_id)

    def start(self, device_id: str) -> DeviceStatus:
        """Start a device with its active calibration, again if it is running.

        Raises:
            UnknownDevice, DeviceWithoutDriver, SensorsChanged, or what the driver raises when it
            is opened. A device that is unplugged is no error: it is waited for.
        """
        with self._exclusive(device_id):
            with self._database.read() as session:
                row = store.get_device(session, device_id)
                source = store.source_of(row)
                found = _in_force(session, device_id)
                stored = store.sensors_of_row(row)
                tracked = tracking_config_of(session, row)
            self._live.set_tracking_config(device_id, tracked)
            driver = make_driver(device_id, source, self._folders)
            self._live.start_device(device_id, driver, found, _only_with(device_id, stored))
            return self._live.status(device_id)

    def stop(self, device_id: str) -> DeviceStatus:
        """Stop a device, also while the database does not answer; raises UnknownDevice."""
        with self._exclusive(device_id):
            if self._live.status(device_id).state == "stopped":
                with self._database.read() as session:
                    store.get_device(session, device_id)
            self._live.stop_device(device_id)
            return self._live.status(device_id)

    def status(self, device_id: str) -> DeviceStatus:
        """Return what a device is doing; raises UnknownDevice."""
        with self._database.read() as session:
            store.get_device(session, device_id)
        return self._live.status(device_id)

    def activate(self, calibration_id: str, expected: str | None = None) -> CalibrationSummary:
        """Make a calibration its device's active one, in the database and then live.

        What is refused is refused before the database's commit. After it nothing is: where the
        running device cannot take the calibration it keeps its own, until its next start.
        ``expected`` is the calibration that is to be active until then.

        Raises:
            UnknownCalibration, CalibrationRetired, SensorsChanged.
            ActivationConflict: another is active than expected, or another move came first.
        """
        with self._database.read() as session:
            device_id = calibrations.get_calibration(session, calibration_id).device_id
            basis = activation_precondition(session, device_id, expected)
        with self._moving(basis, lambda now: now.calibration_id == calibration_id) as session:
            return calibrations.summary(session, calibrations.activate(session, calibration_id))

    def activate_table(self, table_id: str, expected: str | None = None) -> CorrectionTableDocument:
        """Let a correction table's device use it, in the database and then live.

        Raises:
            UnknownCorrectionTable, NoActiveCalibration, ForeignTable, SensorsChanged.
            ActivationConflict: another calibration is active than expected, or another move came
                first.
        """
        with self._database.read() as session:
            device_id = tables.get_table(session, table_id).device_id
            basis = activation_precondition(session, device_id, expected)
        with self._moving(basis, lambda now: now.table_id == table_id) as session:
            return tables.document(session, tables.activate_table(session, table_id))

    def deactivate_table(self, table_id: str) -> CorrectionTableDocument:
        """Let a correction table's device go on without it.

        Raises:
            UnknownCorrectionTable, SensorsChanged.
            ActivationConflict: another move came first.
        """
        with self._database.read() as session:
            device_id = tables.get_table(session, table_id).device_id
            basis = activation_precondition(session, device_id)
        with self._moving(basis, lambda now: now.table_id != table_id) as session:
            return tables.document(session, tables.deactivate_table(session, table_id))

    def roll_back(self, device_id: str, expected: str | None = None) -> Device:
        """Go back to what the device used before its last activation; again: further back.

        Raises:
            UnknownDevice, NothingToRollBack, CalibrationRetired, SensorsChanged.
            ActivationConflict: another calibration is active than expected, or another move came
                first.
        """
        with self._database.read() as session:
            store.get_device(session, device_id)
            basis = activation_precondition(session, device_id, expected)
        with self._moving(basis, lambda _: False) as session:
            target = previous_activation(session, device_id)
            calibrations.usable(session, target.calibration_id)
            move_pointer(session, device_id, target)
            return store.document(session, store.get_device(session, device_id))

    @contextmanager
    def _moving(self, basis: ActivationPrecondition, reached: IsReached) -> Iterator[Session]:
        """Yield a transaction that moves the device's pointer; after its commit tell the device."""
        device_id = basis.device_id
        with self._exclusive(device_id):
            with self._database.write() as session:
                lock_device(session, device_id)
                check_activation_precondition(session, basis, reached)
                yield session
                found = _in_force(session, device_id)
                if found.calibration is not None:
                    device = store.get_device(session, device_id)
                    check_sensors(device_id, store.sensors_of_row(device), found.calibration.models)
            try:
                self._live.set_calibration(device_id, found)
            except Exception:  # noqa: BLE001 - committed: an error would say that it was not
                _log.exception("device %s does not use %s yet", device_id, found.calibration_id)

    @contextmanager
    def tools_change(self, device_id: str) -> Iterator[Session]:
        """Yield a transaction that changes tools of a device; then the live side follows them.

        Raises:
            UnknownDevice.
        """
        with self._exclusive(device_id):
            with self._database.write() as session:
                device = store.get_device(session, device_id, lock=True)
                yield session
                tracked = tracking_config_of(session, device)
            self._follow(device_id, tracked)

    def _follow(self, device_id: str, tracked: TrackingConfig) -> None:
        try:
            self._live.set_tracking_config(device_id, tracked)
        except Exception:  # noqa: BLE001 - committed: an error would say that it was not
            _log.exception("device %s does not follow its tools as stored yet", device_id)

    def _monitor_beam_holds(self) -> None:
        """Let the live side know the beam holds of devices that do not run yet."""
        with self._database.read() as session:
            having = select(DeviceRow).where(DeviceRow.id.in_(select(HoldRow.device_id)))
            rows = session.scalars(having.order_by(DeviceRow.id)).all()
            known = [(row.id, tracking_config_of(session, row)) for row in rows]
        for device_id, tracked in known:
            self._follow(device_id, tracked)

    def autostart(self, *also: str) -> None:
        """Start all devices that say so, and these; one that fails keeps no other waiting."""
        self._monitor_beam_holds()
        with self._database.read() as session:
            wanted = session.scalars(
                select(DeviceRow.id).where(DeviceRow.autostart).order_by(DeviceRow.id)
            ).all()
        for device_id in dict.fromkeys((*wanted, *also)):
            try:
                self.start(device_id)
            except LumilineError as error:
                _log.error("device %s was not started: %s", device_id, error.detail)
            except Exception:  # noqa: BLE001 - a driver's fault must not keep the server down
                _log.exception("device %s was not started", device_id)


def _only_with(device_id: str, stored: Sequence[Sensor]) -> Accept:
    """Return what refuses a device whose sensors are not the stored ones."""

    def accept(description: DeviceDescription) -> None:
        if not sensors_match(description.sensors, stored):
            raise SensorsChanged(
                f'device "{device_id}" is stored with the sensors {listed(stored)}; what is '
                f"connected has {listed(description.sensors)}; connect the right one, or send its "
                "source anew, which reads its sensors",
                device=device_id,
            )

    return accept


def _in_force(session: Session, device_id: str) -> ActiveCalibration:
    """Return the calibration and the table that the device's pointer names."""
    pointer = active(session, device_id)
    if pointer is None:
        return ActiveCalibration()
    calibration = calibrations.get_calibration(session, pointer.calibration_id)
    table = None
    if pointer.table_id is not None:
        table = tables.get_table(session, pointer.table_id)
    return ActiveCalibration(
        calibration.id,
        result_of(calibration.content),
        pointer.table_id,
        tables.content_of(table).table if table else None,
        calibration.content,
        calibration.content_hash,
        table.data if table else None,
    )
