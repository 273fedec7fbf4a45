"""What the server answers about devices, their calibrations, and points from readings."""

from typing import Any

from lumiline.client.response_model import Matrix3, ResponseModel, Vector3


class Sensor(ResponseModel):
    """A line sensor."""

    name: str
    pixels: int
    pitch_um: float


class Device(ResponseModel):
    """A device."""

    id: str
    title: str
    source: dict[str, Any]
    sensors: tuple[Sensor, ...]
    autostart: bool
    active_calibration_id: str | None
    active_table_id: str | None


class DeviceStatus(ResponseModel):
    """What a device is doing."""

    state: str
    reason: str | None = None
    calibration_id: str | None = None
    table_id: str | None = None
    frames: int = 0
    frames_lost_device: int = 0
    frames_dropped_ring: int = 0
    frames_processed: int = 0
    subscribers: int = 0


class StatusResponse(ResponseModel):
    """A device's state under its id."""

    device: str
    status: DeviceStatus


class Calibration(ResponseModel):
    """A calibration without its numbers; ``Client.request`` gets the whole document."""

    id: str
    device: str
    state: str
    provenance: str
    method: str
    note: str
    content_hash: str


class Estimate(ResponseModel):
    """A reconstructed point; no position where ``flags`` say why not."""

    name: str
    position_mm: Vector3 | None
    covariance_mm2: Matrix3 | None
    residual_sigma: float | None
    sensors: tuple[str, ...]
    flags: tuple[str, ...]


class Reconstruction(ResponseModel):
    """Points computed from readings that were posted."""

    id: str
    device: str
    calibration_id: str
    table: str | None
    estimates: tuple[Estimate, ...]
