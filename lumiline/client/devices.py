"""Requests about devices, their calibrations, and points from readings."""

from collections.abc import Mapping

from lumiline.client.exchange import ClientMethod, Exchange, get, get_all, send
from lumiline.client.models import Calibration, Device, DeviceStatus, Reconstruction, ResponseModel

Readings = Mapping[str, float | tuple[float, float]]
"""By sensor: a position [px], or it and its standard deviation."""


class DeviceMethods:
    """Requests about devices, their calibrations, and points from readings."""

    @ClientMethod
    def devices(self) -> Exchange[list[Device]]:
        """All devices."""
        return get_all(Device, "devices")

    @ClientMethod
    def device(self, device_id: str) -> Exchange[Device]:
        """One device."""
        return get(Device, "devices", device_id)

    @ClientMethod
    def device_status(self, device_id: str) -> Exchange[DeviceStatus]:
        """State of a device and its counts of frames."""
        return get(DeviceStatus, "devices", device_id, "status", inside="status")

    @ClientMethod
    def start_device(self, device_id: str) -> Exchange[DeviceStatus]:
        """Start a device."""
        return send(DeviceStatus, "POST", "devices", device_id, "start", inside="status")

    @ClientMethod
    def stop_device(self, device_id: str) -> Exchange[DeviceStatus]:
        """Stop a device."""
        return send(DeviceStatus, "POST", "devices", device_id, "stop", inside="status")

    @ClientMethod
    def calibrations(
        self, device_id: str | None = None, state: str | None = None
    ) -> Exchange[list[Calibration]]:
        """Calibrations, newest first; of one device, in one state."""
        return get_all(Calibration, "calibrations", device=device_id, state=state)

    @ClientMethod
    def calibration(self, calibration_id: str) -> Exchange[Calibration]:
        """One calibration."""
        return get(Calibration, "calibrations", calibration_id)

    @ClientMethod
    def activate(self, calibration_id: str, expected: str | None = None) -> Exchange[Calibration]:
        """Make a calibration the active one; only if ``expected`` is active, where it is given."""
        path = ("calibrations", calibration_id, "activate")
        return send(Calibration, "POST", *path, expected=expected)

    @ClientMethod
    def roll_back(self, device_id: str, expected: str | None = None) -> Exchange[Device]:
        """Go back to the calibration and table that were active before."""
        return send(Device, "POST", "devices", device_id, "roll-back", expected=expected)

    @ClientMethod
    def reconstruct(
        self, device_id: str, points: Mapping[str, Readings], calibration_id: str | None = None
    ) -> Exchange[Reconstruction]:
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
        return send(Reconstruction, "POST", "reconstructions", body=body)

    @ClientMethod
    def reconstructions(self, device_id: str | None = None) -> Exchange[list[ResponseModel]]:
        """Reconstructions without their points, newest first."""
        return get_all(ResponseModel, "reconstructions", device=device_id)


def _reading(value: float | tuple[float, float]) -> float | dict[str, float]:
    if isinstance(value, tuple):
        return {"position_px": float(value[0]), "sigma_px": float(value[1])}
    return float(value)
