"""Makes the driver that a device's source describes; drivers' libraries load only here."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from compute.errors import InvalidParameter
from hardware.driver import Driver, SensorDescription
from service.api.devices.schema import (
    ExternalSource,
    FusionSource,
    GenicamSource,
    ProfileSource,
    ReplaySource,
    Sensor,
    SerialSource,
    Source,
    Tcd1304Source,
)
from service.problems.errors import DeviceWithoutDriver, UnknownRecording
from service.settings import DataFolders

_SENSORS = TypeAdapter(list[Sensor])


Bars = Mapping[str, Sequence[SensorDescription]]
"""Sensors of the devices that a fused one is made of, by their ids; empty for other sources."""


def make_driver(device_id: str, source: Source, folders: DataFolders, bars: Bars) -> Driver:
    """Return the device's driver, not opened.

    Raises:
        DeviceWithoutDriver: the device is an external one.
        UnknownRecording: the recording is not there.
        UnknownDeviceProfile: the profile is not there.
        InvalidParameter: the profile, or what is asked of it, is not possible.
    """
    if isinstance(source, ExternalSource):
        raise DeviceWithoutDriver(
            f'device "{device_id}" is external and has no driver to start; post its readings to '
            "/api/v1/reconstructions",
            device_id=device_id,
        )
    if isinstance(source, FusionSource):
        from service.pipeline.fusion.driver import FusionDriver
        from service.pipeline.fusion.settings import FusedBar

        parts = [FusedBar(bar, tuple(bars[bar])) for bar in source.bars]
        return FusionDriver(device_id, parts, source.settings)
    if isinstance(source, ReplaySource):
        from hardware.replay import ReplayDriver

        return ReplayDriver(
            device_id, recording_path(source.recording_id, folders.recordings), source.speed
        )
    if isinstance(source, ProfileSource):
        from hardware.simulated.profile_driver import ProfileDriver
        from service.api.devices.profiles import find_profile

        profile = find_profile(source.profile_id, folders.profiles)
        return ProfileDriver(device_id, profile, source.settings)
    if isinstance(source, SerialSource):
        from hardware.serial.driver import SerialDriver

        return SerialDriver(device_id, source.settings)
    if isinstance(source, Tcd1304Source):
        from hardware.tcd1304.driver import Tcd1304Driver

        return Tcd1304Driver(device_id, source.settings)
    if isinstance(source, GenicamSource):
        from hardware.genicam.driver import GenicamDriver

        return GenicamDriver(device_id, source.settings)
    from hardware.simulated.driver import SimulatedDriver

    return SimulatedDriver(device_id, source.settings)


def recording_path(name: str, recordings_dir: Path) -> Path:
    """Return the path of a recording, which lies below ``recordings_dir`` after all links.

    Raises:
        UnknownRecording: there is no such file there.
    """
    folder = recordings_dir.resolve()
    path = (folder / name).resolve()
    if not path.is_relative_to(folder) or not path.is_file():
        raise UnknownRecording(
            f'there is no recording "{name}"; put the file into the data directory\'s folder '
            "recordings",
            recording_id=name,
        )
    return path


def sensors_of(device_id: str, source: Source, folders: DataFolders, bars: Bars) -> list[Sensor]:
    """Return the sensors that a source has: given with an external one, else its driver's.

    Raises:
        InvalidParameter: two sensors have one name, or a driver's cannot be used here.
        LumilineError: the driver cannot be opened.
    """
    if isinstance(source, ExternalSource):
        sensors = source.sensors
    elif isinstance(source, FusionSource):
        # Known without its bars, which need not run.
        sensors = validated_sensors(
            make_driver(device_id, source, folders, bars).description.sensors
        )
    else:
        driver = make_driver(device_id, source, folders, bars)
        try:
            driver.open()
            sensors = validated_sensors(driver.description.sensors)
        finally:
            driver.close()
    return check_names(sensors)


def check_names(sensors: list[Sensor]) -> list[Sensor]:
    """Return a device's sensors; raises InvalidParameter where two have one name."""
    names = [sensor.name for sensor in sensors]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InvalidParameter(
            f'two sensors are called "{twice}"; give each sensor a name of its own',
            sensor=twice,
        )
    return sensors


def validated_sensors(described: Iterable[SensorDescription]) -> list[Sensor]:
    """Return a driver's sensors as the service keeps them.

    Raises:
        InvalidParameter: the service cannot use one of them.
    """
    try:
        return _SENSORS.validate_python([asdict(sensor) for sensor in described])
    except ValidationError as error:
        first = error.errors()[0]
        index, *field = first["loc"]
        raise InvalidParameter(
            f"sensor {int(index) + 1} of the driver cannot be used: "
            f"{'.'.join(map(str, field))} is {first['input']!r}: {first['msg']}"
        ) from error
