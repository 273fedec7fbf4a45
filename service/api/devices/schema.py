"""Devices as clients send and receive them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Final, Literal

from pydantic import ConfigDict, Field, StringConstraints
from pydantic.dataclasses import dataclass as checked_dataclass

from compute.camera.model import SensorModel
from hardware.driver import DeviceDescription, SensorDescription
from hardware.field_bounds import FIRST_ERROR_ONLY
from hardware.genicam.settings import GenicamSettings
from hardware.serial.settings import SerialSettings
from hardware.simulated.profile_settings import ProfileSettings
from hardware.simulated.settings import SimulationSettings
from hardware.tcd1304.settings import Tcd1304Settings
from service.api.base_models import Moment, Name, RequestModel, ResponseModel, Slug, Text200, absent
from service.api.devices.tracking_settings import Tracking
from service.pipeline.device_status import DeviceStatus
from service.pipeline.fusion.settings import FusionSettings
from service.problems.errors import SensorsChanged

RECORDING_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_-]*(\.[A-Za-z0-9_-]+)*(/[A-Za-z0-9][A-Za-z0-9_.-]*)*$"
PROFILE_PATTERN = r"^[a-z0-9]([a-z0-9.-]{0,61}[a-z0-9])?$"


@checked_dataclass(frozen=True, config=ConfigDict(extra="forbid", allow_inf_nan=False))
class Sensor(SensorDescription):
    """One line sensor: name, number of pixels, pixel pitch [um]."""

    name: Name
    pixels: Annotated[int, Field(ge=8, le=65536)]
    pitch_um: Annotated[float, Field(gt=0, le=1000, description="Pixel pitch [um].")]


class SimulatedSource(RequestModel):
    """Line scans from the simulator."""

    kind: Literal["simulated"]
    settings: SimulationSettings = Field(default_factory=SimulationSettings)


class ProfileSource(RequestModel):
    """Line scans of a device simulated from its profile: its optics, light and detector."""

    kind: Literal["profile"]
    profile_id: Annotated[
        str,
        StringConstraints(pattern=PROFILE_PATTERN),
        Field(description="A device profile's name: see `/api/v1/device-profiles`."),
    ]
    settings: ProfileSettings = Field(default_factory=ProfileSettings)


class ReplaySource(RequestModel):
    """Line scans from a recording in the data directory's folder ``recordings``."""

    kind: Literal["replay"]
    recording_id: Annotated[
        str,
        StringConstraints(max_length=200, pattern=RECORDING_PATTERN),
        Field(description="File name below the folder `recordings`."),
    ]
    speed: Annotated[float, Field(gt=0, le=1000)] | None = Field(
        default=1.0, description="1: as recorded; null: as fast as frames are processed."
    )


class SerialSource(RequestModel):
    """A device on a serial port with the line-scan protocol (docs/reference/serial-protocol.md)."""

    kind: Literal["serial"]
    settings: SerialSettings


class Tcd1304Source(RequestModel):
    """Open TCD1304 boards, each at a serial port (docs/how-to/tcd1304.md)."""

    kind: Literal["tcd1304"]
    settings: Tcd1304Settings


class GenicamSource(RequestModel):
    """GenICam line-scan cameras, GigE Vision or USB3 Vision (docs/how-to/genicam.md)."""

    kind: Literal["genicam"]
    settings: GenicamSettings


class FusionSource(RequestModel):
    """The peaks of two bars or more that see one volume (docs/how-to/fusion.md)."""

    kind: Literal["fusion"]
    bars: Annotated[
        list[Slug],
        Field(
            min_length=2,
            max_length=8,
            description="Their devices, which run beside this one. The first that is there gives "
            "the times of frames.",
        ),
        FIRST_ERROR_ONLY,
    ]
    settings: FusionSettings = Field(default_factory=FusionSettings)


class ExternalSource(RequestModel):
    """No driver: a program of yours reads the sensors and posts peak positions."""

    kind: Literal["external"]
    sensors: Annotated[list[Sensor], Field(min_length=1, max_length=64), FIRST_ERROR_ONLY]


Source = Annotated[
    SimulatedSource
    | ProfileSource
    | ReplaySource
    | SerialSource
    | Tcd1304Source
    | GenicamSource
    | FusionSource
    | ExternalSource,
    Field(discriminator="kind"),
]


_STATION: Final = (
    "The station on another machine that the device is connected to, as `/api/v1/stations` lists "
    "them; null: this server itself."
)


class NewDevice(RequestModel):
    """A device to create."""

    id: Slug
    title: Text200
    source: Source
    station: Slug | None = Field(default=None, description=_STATION)
    autostart: bool = Field(
        default=False, description="Start it together with the server, or with its station."
    )
    tracking: Tracking = Field(default_factory=Tracking)


class DeviceChange(RequestModel):
    """Changes of a device; a field left out stays as it is, of `tracking` too."""

    title: Text200 = absent()
    station: Slug | None = absent()
    source: Source = absent()
    autostart: bool = absent()
    tracking: Tracking = absent()


class Device(ResponseModel):
    """A device."""

    # Activations change these, and a PATCH changes none of them (but the time): who read the
    # device before its own activation may change its title after it.
    MEMBERS_APART: ClassVar[frozenset[str]] = frozenset(
        {"active_calibration_id", "active_table_id", "active_radiometric_id", "updated_at"}
    )

    id: str
    title: str
    station: str | None = Field(description=_STATION)
    source: Source
    sensors: list[Sensor] = Field(description="In the order of the scans of a frame.")
    autostart: bool
    tracking: Tracking
    active_calibration_id: str | None
    active_table_id: str | None = Field(description="The correction table used with it.")
    active_radiometric_id: str | None = Field(
        description="The radiometric calibration that peaks are found with; null: none."
    )
    created_at: Moment
    updated_at: Moment


@dataclass(frozen=True, kw_only=True)
class DeviceStateDocument(DeviceStatus):
    """State and counters of a device."""

    device_id: str


def state_document(device_id: str, status: DeviceStatus) -> DeviceStateDocument:
    """Return what a device is doing as clients see it."""
    return DeviceStateDocument(device_id=device_id, **vars(status))


class Activation(ResponseModel):
    """One move of the pointer to the active calibration."""

    id: int
    device_id: str
    calibration_id: str
    previous_calibration_id: str | None
    table_id: str | None = Field(description="Its correction table; null: without one.")
    previous_table_id: str | None
    restores_id: int | None = Field(description="The earlier move that a roll-back went back to.")
    activated_at: Moment
    actor: str | None = Field(description="Who did it; null: not known, there are no users yet.")


AnySensor = SensorDescription | SensorModel


def sensors_match(one: Sequence[AnySensor], other: Sequence[AnySensor]) -> bool:
    """Whether two lists are of the same sensors: readings and models go by position."""
    return _layout(one) == _layout(other)


def check_sensors(
    device_id: str, now: Sequence[SensorDescription], made: Sequence[AnySensor]
) -> None:
    """Check that a calibration is of the device's sensors.

    Args:
        device_id: the device.
        now: its sensors.
        made: the sensors, or their models, that the calibration was made for.

    Raises:
        SensorsChanged: a name, a number of pixels or the order differs.
    """
    if not sensors_match(now, made):
        raise SensorsChanged(
            f'device "{device_id}" has the sensors {listed(now)}; the calibration was made for '
            f"{listed(made)}; calibrate the sensors that the device has now",
            device_id=device_id,
        )


def _layout(sensors: Sequence[AnySensor]) -> list[tuple[str, int]]:
    return [(sensor.name, sensor.pixels) for sensor in sensors]


def listed(sensors: Sequence[AnySensor]) -> str:
    """Return the sensors' names and pixel counts as text for messages."""
    return ", ".join(f'"{name}" ({pixels} px)' for name, pixels in _layout(sensors))


def check_connected_sensors(
    device_id: str, stored: Sequence[Sensor], found: DeviceDescription
) -> None:
    """Refuse a device whose sensors are not the stored ones; raises SensorsChanged."""
    if not sensors_match(found.sensors, stored):
        raise SensorsChanged(
            f'device "{device_id}" is stored with the sensors {listed(stored)}; what is '
            f"connected has {listed(found.sensors)}; connect the right one, or send its "
            "source anew, which reads its sensors",
            device_id=device_id,
        )
