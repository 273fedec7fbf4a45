"""Requests about devices, their calibrations, and points from readings."""

from collections.abc import Mapping

from lumiline.client.exchange import ClientMethod, Exchanges
from lumiline.client.models import Calibration, Device, DeviceStatus, Reconstruction, ResponseModel

Readings = Mapping[str, float | tuple[float, float]]
"""By sensor: a position [px], or it and its standard deviation."""


class DeviceMethods(Exchanges):
    """Requests about devices, their calibrations, and points from readings."""

    @ClientMethod
    async def devices(self) -> list[Device]:
        """All devices."""
        return await self._get_all(Device, "devices")

    @ClientMethod
    async def device(self, device_id: str) -> Device:
        """One device."""
        return await self._get(Device, "devices", device_id)

    @ClientMethod
    async def device_status(self, device_id: str) -> DeviceStatus:
        """State of a device and its counts of frames."""
        return await self._get(DeviceStatus, "devices", device_id, "status", inside="status")

    @ClientMethod
    async def start_device(self, device_id: str) -> DeviceStatus:
        """Start a device."""
        return await self._send(
            DeviceStatus, "POST", "devices", device_id, "start", inside="status"
        )

    @ClientMethod
    async def stop_device(self, device_id: str) -> DeviceStatus:
        """Stop a device."""
        return await self._send(DeviceStatus, "POST", "devices", device_id, "stop", inside="status")

    @ClientMethod
    async def calibrations(
        self, device_id: str | None = None, state: str | None = None
    ) -> list[Calibration]:
        """Calibrations, newest first; of one device, in one state."""
        return await self._get_all(Calibration, "calibrations", device=device_id, state=state)

    @ClientMethod
    async def calibration(self, calibration_id: str) -> Calibration:
        """One calibration."""
        return await self._get(Calibration, "calibrations", calibration_id)

    @ClientMethod
    async def activate(self, calibration_id: str, expected: str | None = None) -> Calibration:
        """Make a calibration the active one; only if ``expected`` is active, where it is given."""
        path = ("calibrations", calibration_id, "activate")
        return await self._send(Calibration, "POST", *path, expected=expected)

    @ClientMethod
    async def roll_back(self, device_id: str, expected: str | None = None) -> Device:
        """Go back to the calibration and table that were active before."""
        return await self._send(
            Device, "POST", "devices", device_id, "roll-back", expected=expected
        )

    @ClientMethod
    async def reconstruct(
        self, device_id: str, points: Mapping[str, Readings], calibration_id: str | None = None
    ) -> Reconstruction:
        """Compute points from readings.

        Args:
            device_id: the device.
            points: readings of each point, by its name.
            calibration_id: the calibration; None: the active one.
        """
        body = {
            "device": device_id,
            "calibration": calibration_id,
            "points": [
                {
                    "name": name,
                    "readings": {sensor: _reading(value) for sensor, value in readings.items()},
                }
                for name, readings in points.items()
            ],
        }
        return await self._send(Reconstruction, "POST", "reconstructions", body=body)

    @ClientMethod
    async def reconstructions(self, device_id: str | None = None) -> list[ResponseModel]:
        """Reconstructions without their points, newest first."""
        return await self._get_all(ResponseModel, "reconstructions", device=device_id)


def _reading(value: float | tuple[float, float]) -> float | dict[str, float]:
    if isinstance(value, tuple):
        return {"position_px": float(value[0]), "sigma_px": float(value[1])}
    return float(value)
