"""A live side that records its calls, and the test client, for tests of the REST side."""

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hardware.driver import DeviceDescription, Driver
from service.errors import DeviceNotRunning
from service.live.hub import Hub
from service.live.in_force import NOTHING, InForce
from service.live.manager import LiveManager
from service.live.session import DeviceStatus

with warnings.catch_warnings():
    # Starlette asks for httpx2 in place of httpx; both work, and the service itself uses httpx.
    warnings.simplefilter("ignore")
    from starlette.testclient import TestClient, WebSocketDenialResponse

__all__ = ["RecordedLive", "TestClient", "WebSocketDenialResponse"]


class RecordedLive(LiveManager):
    """Takes the live pipeline's calls, opens drivers, and runs nothing."""

    def __init__(self) -> None:
        self.hub = Hub()
        self.calls: list[tuple[Any, ...]] = []
        self.states: dict[str, DeviceStatus] = {}
        self.seen_px = np.full(4, 1000.0)
        self.in_force: dict[str, InForce] = {}
        self.answers = True

    @property
    def ready(self) -> bool:
        return self.answers

    def start_device(
        self,
        device_id: str,
        driver: Driver,
        found: InForce = NOTHING,
    ) -> DeviceDescription:
        driver.open()
        try:
            description = driver.description
        finally:
            driver.close()
        self.in_force[device_id] = found
        self.calls.append(("start", device_id, found.calibration_id, found.calibration))
        self.states[device_id] = DeviceStatus("running", calibration_id=found.calibration_id)
        return description

    def stop_device(self, device_id: str) -> None:
        self.calls.append(("stop", device_id))
        if device_id in self.states:
            self.states[device_id] = DeviceStatus("stopped")

    def forget_device(self, device_id: str) -> None:
        self.calls.append(("forget", device_id))
        self.states.pop(device_id, None)

    def set_calibration(self, device_id: str, found: InForce) -> None:
        self.calls.append(("calibration", device_id, found.calibration_id, found.calibration))
        self.in_force[device_id] = found

    def status(self, device_id: str) -> DeviceStatus:
        return self.states.get(device_id, DeviceStatus("stopped"))

    def describe(self, device_id: str) -> DeviceDescription | None:
        return None

    def collect(
        self, device_id: str, frames: int, marker: int | None, timeout_s: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        if self.status(device_id).state != "running":
            raise DeviceNotRunning(f'device "{device_id}" does not run')
        self.calls.append(("collect", device_id, frames, marker))
        noise = np.random.default_rng(1).normal(0.0, 0.05, (frames, 4))
        return self.seen_px + noise, np.full((frames, 4), 0.05)

    def close(self) -> None:
        self.calls.append(("close",))
