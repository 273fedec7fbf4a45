"""GatewayDuties: what this server does beside others, as its leases and their changes ask."""

import logging
from collections.abc import Callable, Iterable
from threading import Event, Thread
from typing import Final

from service.api.devices.device_service import DeviceService
from service.database.gateway import DEVICES, Gateway
from service.problems.errors import NotReady

_log = logging.getLogger(__name__)

LOOK_S: Final = 1.0
"""How often it looks where nobody wakes it."""
ANNOUNCE_S: Final = 2.0


class GatewayDuties:
    """Two threads: one for devices, which waits for nothing else, and one that lists files.

    Args:
        gateway: this server.
        devices: started when the lease of devices is had, stopped when it is lost.
        named: devices to start beside those that start by themselves.
        announce: list the files of this server for others.
        tidy: called when the data directory has become this server's to tidy.
    """

    def __init__(
        self,
        gateway: Gateway,
        devices: DeviceService,
        named: tuple[str, ...],
        announce: Iterable[Callable[[], None]],
        tidy: Callable[[], None],
    ) -> None:
        self._gateway = gateway
        self._devices = devices
        self._named = named
        self._announce = tuple(announce)
        self._tidy = tidy
        self._has_devices = self._has_files = False
        self._woken = Event()
        self._ended = Event()
        self._threads = [
            Thread(target=self._look_forever, name="gateway duties", daemon=True),
            Thread(target=self._announce_forever, name="gateway files", daemon=True),
        ]

    def start(self) -> None:
        """Start the devices if they are this server's, and go on with that."""
        self._look()
        if self._gateway.shared:
            self._gateway.watch(self._woken.set)
            for thread in self._threads:
                thread.start()

    def close(self) -> None:
        """End it; devices that run go on."""
        self._ended.set()
        self._woken.set()
        for thread in self._threads:
            if thread.is_alive():
                thread.join(10.0)

    def _look_forever(self) -> None:
        while not self._ended.is_set():
            self._woken.wait(LOOK_S)
            self._woken.clear()
            if self._ended.is_set():
                return
            try:
                self._look()
            except NotReady:
                pass  # logged there; the next look tries again
            except Exception:  # noqa: BLE001 - this thread must not end
                _log.exception("gateway: its duties failed")

    def _look(self) -> None:
        has_devices = self._gateway.holds(DEVICES)
        if has_devices and not self._has_devices:
            self._devices.autostart(*self._named)
            self._has_devices = True
        elif self._has_devices and not has_devices:
            _log.warning("another gateway has the devices; they are stopped here")
            self._devices.give_up()
            self._has_devices = False
        if has_devices:
            for device_id, number in self._gateway.changes():
                self._devices.follow(device_id)
                self._gateway.followed(device_id, number)

    def _announce_forever(self) -> None:
        while not self._ended.wait(ANNOUNCE_S):
            try:
                has_files = self._gateway.holds(self._gateway.files_lease)
                if has_files and not self._has_files:
                    self._tidy()
                self._has_files = has_files
                for announce in self._announce:
                    announce()
            except NotReady:
                pass  # logged there
            except Exception:  # noqa: BLE001 - this thread must not end
                _log.exception("gateway: its files are not listed now")
