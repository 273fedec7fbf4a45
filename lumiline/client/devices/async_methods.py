"""AsyncClient's methods for devices, their calibrations, and points from readings."""

from collections.abc import Mapping

from lumiline.client.answer import Answer
from lumiline.client.async_connection import AsyncConnection
from lumiline.client.devices import calls
from lumiline.client.devices import documents as d
from lumiline.client.devices.calls import Readings


class AsyncDeviceMethods(AsyncConnection):
    """Devices, their calibrations, and points from readings, with asyncio."""

    async def devices(self) -> list[d.Device]:
        """All devices."""
        return await self._all(calls.devices())

    async def device(self, device_id: str) -> d.Device:
        """One device."""
        return await self._one(calls.device(device_id))

    async def device_status(self, device_id: str) -> d.DeviceStatus:
        """What a device is doing."""
        return await self._one(calls.device_status(device_id))

    async def start_device(self, device_id: str) -> d.DeviceStatus:
        """Start a device."""
        return (await self._one(calls.start_device(device_id))).status

    async def stop_device(self, device_id: str) -> d.DeviceStatus:
        """Stop a device."""
        return (await self._one(calls.stop_device(device_id))).status

    async def calibrations(
        self, device_id: str | None = None, state: str | None = None
    ) -> list[d.Calibration]:
        """Calibrations, of a device, in a state, newest first."""
        return await self._all(calls.calibrations(device_id, state))

    async def calibration(self, calibration_id: str) -> d.Calibration:
        """One calibration."""
        return await self._one(calls.calibration(calibration_id))

    async def activate(self, calibration_id: str, expected: str | None = None) -> d.Calibration:
        """Make a calibration the active one; only if ``expected`` is active, where it is given."""
        return await self._one(calls.activate(calibration_id, expected))

    async def roll_back(self, device_id: str, expected: str | None = None) -> d.Device:
        """Go back to the calibration and table that were active before."""
        return await self._one(calls.roll_back(device_id, expected))

    async def reconstruct(
        self, device_id: str, points: Mapping[str, Readings], calibration_id: str | None = None
    ) -> d.Reconstruction:
        """Compute points from readings, by name and sensor."""
        return await self._one(calls.reconstruct(device_id, points, calibration_id))

    async def reconstructions(self, device_id: str | None = None) -> list[Answer]:
        """Reconstructions without their points, newest first."""
        return await self._all(calls.reconstructions(device_id))
