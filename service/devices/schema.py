"""Devices as clients send and receive them."""

from typing import Annotated, Literal

from pydantic import ConfigDict, Field, StringConstraints
from pydantic.dataclasses import dataclass as checked_dataclass

from hardware.driver import SensorDescription
from hardware.simulated.profile_settings import ProfileSettings
from hardware.simulated.settings import SimulationSettings
from service.live.session import DeviceStatus
from service.schema import Document, Given, Moment, Name, Slug, Text200, absent

RECORDING_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_-]*(\.[A-Za-z0-9_-]+)*(/[A-Za-z0-9][A-Za-z0-9_.-]*)*$"
PROFILE_PATTERN = r"^[a-z0-9]([a-z0-9.-]{0,61}[a-z0-9])?$"


@checked_dataclass(frozen=True, config=ConfigDict(extra="forbid", allow_inf_nan=False))
class Sensor(SensorDescription):
    """One line sensor: name, number of pixels, pixel pitch [um]."""

    name: Name
    pixels: Annotated[int, Field(ge=8, le=65536)]
    pitch_um: Annotated[float, Field(gt=0, le=1000, description="Pixel pitch [um].")]


class SimulatedSource(Given):
    """Line scans from the simulator."""

    kind: Literal["simulated"]
    settings: SimulationSettings = Field(default_factory=SimulationSettings)


class ProfileSource(Given):
    """Line scans of a device simulated from its profile: its optics, light and detector."""

    kind: Literal["profile"]
    profile: Annotated[
        str,
        StringConstraints(pattern=PROFILE_PATTERN),
        Field(description="A device profile's name: see `/api/v1/device-profiles`."),
    ]
    settings: ProfileSettings = Field(default_factory=ProfileSettings)


class ReplaySource(Given):
    """Line scans from a recording in the data directory's folder ``recordings``."""

    kind: Literal["replay"]
    recording: Annotated[
        str,
        StringConstraints(max_length=200, pattern=RECORDING_PATTERN),
        Field(description="File name below the folder `recordings`."),
    ]
    speed: Annotated[float, Field(gt=0, le=1000, description="1: as recorded.")] = 1.0


class ExternalSource(Given):
    """No driver: a program of yours reads the sensors and posts peak positions."""

    kind: Literal["external"]
    sensors: Annotated[list[Sensor], Field(min_length=1, max_length=64)]


Source = Annotated[
    SimulatedSource | ProfileSource | ReplaySource | ExternalSource, Field(discriminator="kind")
]


class NewDevice(Given):
    """A device to create."""

    id: Slug
    title: Text200
    source: Source
    autostart: bool = Field(default=False, description="Start it together with the server.")


class DeviceChange(Given):
    """What may be changed of a device; a field left out stays as it is."""

    title: Text200 = absent()
    source: Source = absent()
    autostart: bool = absent()


class Device(Document):
    """A device."""

    id: str
    title: str
    source: Source
    sensors: list[Sensor] = Field(description="In the order of the lines of a frame.")
    autostart: bool
    active_calibration_id: str | None
    active_table_id: str | None = Field(description="The correction table used with it.")
    created_at: Moment
    updated_at: Moment


class Status(Document):
    """What a device is doing."""

    device: str
    status: DeviceStatus


class Activation(Document):
    """One move of the pointer to the active calibration."""

    id: int
    device: str
    calibration_id: str
    previous_calibration_id: str | None
    table_id: str | None = Field(description="Its correction table; null: without one.")
    previous_table_id: str | None
    restores_id: int | None = Field(description="The earlier move that a roll-back went back to.")
    activated_at: Moment
    actor: str | None = Field(description="Who did it; null: not known, there are no users yet.")
