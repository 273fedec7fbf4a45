"""AsyncClient's methods for devices, their calibrations, and points from readings."""

from collections.abc import Mapping

from lumiline.client.async_connection import AsyncConnection
from lumiline.client.devices import models as d
from lumiline.client.devices import requests
from lumiline.client.devices.requests import Readings
from lumiline.client.response_model import ResponseModel


class AsyncDeviceMethods(AsyncConnection):
    """Devices, their calibrations, and points from readings, with asyncio."""

    async def devices(self) -> list[d.Device]:
        """All devices."""
        return await self._all(requests.devices())

    async def device(self, device_id: str) -> d.Device:
        """One device."""
        return await self._one(requests.device(device_id))

    async def device_status(self, device_id: str) -> d.DeviceStatus:
        """What a device is doing."""
        return await self._one(requests.device_status(device_id))

    async def start_device(self, device_id: str) -> d.DeviceStatus:
        """Start a device."""
        return (await self._one(requests.start_device(device_id))).status

    async def stop_device(self, device_id: str) -> d.DeviceStatus:
        """Stop a device."""
        return (await self._one(requests.stop_device(device_id))).status

    async def calibrations(
        self, device_id: str | None = None, state: str | None = None
    ) -> list[d.Calibration]:
        """Calibrations, of a device, in a state, newest first."""
        return await self._all(requests.calibrations(device_id, state))

    async def calibration(self, calibration_id: str) -> d.Calibration:
        """One calibration."""
        return await self._one(requests.calibration(calibration_id))

    async def activate(self, calibration_id: str, expected: str | None = None) -> d.Calibration:
        """Make a calibration the active one; only if ``expected`` is active, where it is given."""
        return await self._one(requests.activate(calibration_id, expected))

    async def roll_back(self, device_id: str, expected: str | None = None) -> d.Device:
        """Go back to the calibration and table that were active before."""
        return await self._one(requests.roll_back(device_id, expected))

    async def reconstruct(
        self, device_id: str, points: Mapping[str, Readings], calibration_id: str | None = None
    ) -> d.Reconstruction:
        """Compute points from readings, by name and sensor."""
        return await self._one(requests.reconstruct(device_id, points, calibration_id))

    async def reconstructions(self, device_id: str | None = None) -> list[ResponseModel]:
        """Reconstructions without their points, newest first."""
        return await self._all(requests.reconstructions(device_id))
