"""Client's methods for devices, their calibrations, and points from readings."""

from collections.abc import Mapping

from lumiline.client.answer import Answer
from lumiline.client.connection import Connection
from lumiline.client.devices import calls
from lumiline.client.devices import documents as d
from lumiline.client.devices.calls import Readings


class DeviceMethods(Connection):
    """Devices, their calibrations, and points from readings."""

    def devices(self) -> list[d.Device]:
        """All devices."""
        return self._all(calls.devices())

    def device(self, device_id: str) -> d.Device:
        """One device."""
        return self._one(calls.device(device_id))

    def device_status(self, device_id: str) -> d.DeviceStatus:
        """What a device is doing."""
        return self._one(calls.device_status(device_id))

    def start_device(self, device_id: str) -> d.DeviceStatus:
        """Start a device."""
        return self._one(calls.start_device(device_id)).status

    def stop_device(self, device_id: str) -> d.DeviceStatus:
        """Stop a device."""
        return self._one(calls.stop_device(device_id)).status

    def calibrations(
        self, device_id: str | None = None, state: str | None = None
    ) -> list[d.Calibration]:
        """Calibrations, of a device, in a state, newest first."""
        return self._all(calls.calibrations(device_id, state))

    def calibration(self, calibration_id: str) -> d.Calibration:
        """One calibration."""
        return self._one(calls.calibration(calibration_id))

    def activate(self, calibration_id: str, expected: str | None = None) -> d.Calibration:
        """Make a calibration the active one; only if ``expected`` is active, where it is given."""
        return self._one(calls.activate(calibration_id, expected))

    def roll_back(self, device_id: str, expected: str | None = None) -> d.Device:
        """Go back to the calibration and table that were active before."""
        return self._one(calls.roll_back(device_id, expected))

    def reconstruct(
        self, device_id: str, points: Mapping[str, Readings], calibration_id: str | None = None
    ) -> d.Reconstruction:
        """Compute points from readings, by name and sensor."""
        return self._one(calls.reconstruct(device_id, points, calibration_id))

    def reconstructions(self, device_id: str | None = None) -> list[Answer]:
        """Reconstructions without their points, newest first."""
        return self._all(calls.reconstructions(device_id))
