"""StationDevices: makes the devices of a station what the database says, whoever has changed it."""

import hashlib
import logging
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from threading import Lock
from typing import Any

import numpy as np
from sqlalchemy import select

from compute.errors import LumilineError
from service.api.devices.device_service import DeviceService
from service.database.engine import Database
from service.database.models import DeviceRow
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.interface import Pipeline
from service.pipeline.tracking_config import TrackingConfig
from service.problems.errors import UnknownDevice

_log = logging.getLogger(__name__)


class StationDevices:
    """Starts devices, and takes over what gateways have stored; all of it may be done again.

    Args:
        own: the station's name.
        database: the database.
        live: the station's pipeline.
        service: starts its devices.
    """

    def __init__(
        self, own: str, database: Database, live: Pipeline, service: DeviceService
    ) -> None:
        self._own = own
        self._database = database
        self._live = live
        self._service = service
        self._applied: dict[str, tuple[str, str]] = {}
        """Digests of calibration and tracking configuration of each device."""
        self._lock = Lock()

    @property
    def digests(self) -> dict[str, str]:
        """What each device uses and tracks, as a digest: another where that has changed."""
        return {name: "-".join(one) for name, one in tuple(self._applied.items())}

    def start(self, device_id: str) -> None:
        """Start a device as the database says, again if it is running; raises LumilineError."""
        self._check_own(device_id)
        self._service.start(device_id)
        self.apply(device_id)

    def apply(self, device_id: str) -> None:
        """Let a device use and track what the database says.

        Raises:
            UnknownDevice: it is not of this station any more.
        """
        with self._lock:
            calibration, tracking = self._check_own(device_id)
            now = digest(calibration), digest(tracking)
            before = self._applied.get(device_id, (None, None))
            if now[1] != before[1]:
                self._live.set_tracking_config(device_id, tracking)
            if now[0] != before[0]:
                self._live.set_calibration(device_id, calibration)
            self._applied[device_id] = now

    def forget(self, device_id: str) -> None:
        """Stop a device and forget it: it is deleted, or of another station now."""
        with self._lock:
            self._applied.pop(device_id, None)
        self._live.forget_device(device_id)

    def begin(self) -> None:
        """Take over all devices of this station, and start those that say so."""
        self.reconcile()
        self._service.autostart()

    def reconcile(self) -> None:
        """Make all devices what the database says; raises what reading it raises."""
        with self._database.read() as session:
            query = select(DeviceRow.id).where(DeviceRow.station == self._own)
            own = set(session.scalars(query))
        for device_id in own:
            try:
                self.apply(device_id)
            except LumilineError as error:
                _log.error("device %s is not as it is stored: %s", device_id, error.detail)
        for device_id in (self._applied.keys() | self._live.statuses().keys()) - own:
            _log.info("device %s is not of this station any more", device_id)
            self.forget(device_id)

    def _check_own(self, device_id: str) -> tuple[ActiveCalibration, TrackingConfig]:
        station, calibration, tracking = self._service.stored(device_id)
        if station != self._own:
            raise UnknownDevice(
                f'device "{device_id}" is not of the station "{self._own}"', device_id=device_id
            )
        return calibration, tracking


def digest(value: Any) -> str:
    """Return a digest of a configuration: the same for equal content, read at any time."""
    found = hashlib.sha256()
    _add(found, value)
    return found.hexdigest()[:16]


def _add(found: Any, value: Any) -> None:
    if isinstance(value, ActiveCalibration):
        radiometric = value.radiometric
        ids = (value.calibration_id, value.calibration_hash, value.table_id)
        value = (*ids, radiometric and radiometric.content_hash)
    if isinstance(value, np.ndarray):
        found.update(f"{value.dtype.str}{value.shape}".encode() + value.tobytes())
    elif is_dataclass(value):
        found.update(type(value).__name__.encode())
        for member in fields(value):
            _add(found, getattr(value, member.name))
    elif isinstance(value, Mapping):
        for key in sorted(value, key=repr):
            _add(found, (key, value[key]))
    elif isinstance(value, tuple | list):
        found.update(f"[{len(value)}".encode())
        for one in value:
            _add(found, one)
    else:
        found.update(f"{type(value).__name__}:{value!r};".encode())
