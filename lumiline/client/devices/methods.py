"""Client's methods for devices, their calibrations, and points from readings."""

from collections.abc import Mapping

from lumiline.client.connection import Connection
from lumiline.client.devices import models as d
from lumiline.client.devices import requests
from lumiline.client.devices.requests import Readings
from lumiline.client.response_model import ResponseModel


class DeviceMethods(Connection):
    """Devices, their calibrations, and points from readings."""

    def devices(self) -> list[d.Device]:
        """All devices."""
        return self._all(requests.devices())

    def device(self, device_id: str) -> d.Device:
        """One device."""
        return self._one(requests.device(device_id))

    def device_status(self, device_id: str) -> d.DeviceStatus:
        """What a device is doing."""
        return self._one(requests.device_status(device_id))

    def start_device(self, device_id: str) -> d.DeviceStatus:
        """Start a device."""
        return self._one(requests.start_device(device_id)).status

    def stop_device(self, device_id: str) -> d.DeviceStatus:
        """Stop a device."""
        return self._one(requests.stop_device(device_id)).status

    def calibrations(
        self, device_id: str | None = None, state: str | None = None
    ) -> list[d.Calibration]:
        """Calibrations, of a device, in a state, newest first."""
        return self._all(requests.calibrations(device_id, state))

    def calibration(self, calibration_id: str) -> d.Calibration:
        """One calibration."""
        return self._one(requests.calibration(calibration_id))

    def activate(self, calibration_id: str, expected: str | None = None) -> d.Calibration:
        """Make a calibration the active one; only if ``expected`` is active, where it is given."""
        return self._one(requests.activate(calibration_id, expected))

    def roll_back(self, device_id: str, expected: str | None = None) -> d.Device:
        """Go back to the calibration and table that were active before."""
        return self._one(requests.roll_back(device_id, expected))

    def reconstruct(
        self, device_id: str, points: Mapping[str, Readings], calibration_id: str | None = None
    ) -> d.Reconstruction:
        """Compute points from readings, by name and sensor."""
        return self._one(requests.reconstruct(device_id, points, calibration_id))

    def reconstructions(self, device_id: str | None = None) -> list[ResponseModel]:
        """Reconstructions without their points, newest first."""
        return self._all(requests.reconstructions(device_id))
