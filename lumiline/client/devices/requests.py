"""Requests about devices, their calibrations, and points from readings, for both clients."""

from collections.abc import Mapping

from lumiline.client.api_request import ApiRequest, get, post
from lumiline.client.devices import models as d
from lumiline.client.response_model import ResponseModel

Readings = Mapping[str, float | tuple[float, float]]
"""By sensor: a position [px], or it and its standard deviation."""


def devices() -> ApiRequest[d.Device]:
    """All devices."""
    return get(d.Device, "devices")


def device(device_id: str) -> ApiRequest[d.Device]:
    """One device."""
    return get(d.Device, "devices", device_id)


def device_status(device_id: str) -> ApiRequest[d.DeviceStatus]:
    """What a device is doing."""
    return get(d.DeviceStatus, "devices", device_id, "status", inside="status")


def start_device(device_id: str) -> ApiRequest[d.StatusResponse]:
    """Start a device."""
    return post(d.StatusResponse, "devices", device_id, "start")


def stop_device(device_id: str) -> ApiRequest[d.StatusResponse]:
    """Stop a device."""
    return post(d.StatusResponse, "devices", device_id, "stop")


def calibrations(device_id: str | None, state: str | None) -> ApiRequest[d.Calibration]:
    """Calibrations, newest first."""
    return get(d.Calibration, "calibrations", device=device_id, state=state)


def calibration(calibration_id: str) -> ApiRequest[d.Calibration]:
    """One calibration."""
    return get(d.Calibration, "calibrations", calibration_id)


def activate(calibration_id: str, expected: str | None) -> ApiRequest[d.Calibration]:
    """Make a calibration the active one."""
    return post(d.Calibration, "calibrations", calibration_id, "activate", expected=expected)


def roll_back(device_id: str, expected: str | None) -> ApiRequest[d.Device]:
    """Go back to what was active before."""
    return post(d.Device, "devices", device_id, "roll-back", expected=expected)


def reconstruct(
    device_id: str, points: Mapping[str, Readings], calibration_id: str | None
) -> ApiRequest[d.Reconstruction]:
    """Compute points from readings."""
    body = {
        "device": device_id,
        "calibration": calibration_id,
        "points": [
            {"name": name, "readings": {one: _reading(given) for one, given in readings.items()}}
            for name, readings in points.items()
        ],
    }
    return post(d.Reconstruction, "reconstructions", body=body)


def reconstructions(device_id: str | None) -> ApiRequest[ResponseModel]:
    """Reconstructions without their points."""
    return get(ResponseModel, "reconstructions", device=device_id)


def _reading(given: float | tuple[float, float]) -> float | dict[str, float]:
    if isinstance(given, tuple):
        return {"position_px": float(given[0]), "sigma_px": float(given[1])}
    return float(given)
