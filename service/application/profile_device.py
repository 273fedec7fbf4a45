"""Makes the device of a profile, with the calibration of its traced optics."""

from dataclasses import dataclass

from pydantic import ValidationError
from sqlalchemy.orm import Session

from compute.calibration.result import Calibration
from compute.errors import InvalidParameter
from compute.optics.profiles.device_profile import DeviceProfile
from hardware.simulated.profile_driver import ProfileDriver
from hardware.simulated.profile_settings import ProfileSettings
from service.api.calibrations.schema import CalibratedProfile
from service.api.devices.driver_factory import validated_sensors
from service.api.devices.nominal_calibration import nominal_calibration, nominal_note
from service.api.devices.schema import NewDevice, ProfileSource, Sensor
from service.api.devices.store import add_device, source_of
from service.application.initial_content import store_nominal
from service.database.models import DeviceRow


@dataclass(frozen=True)
class ProfileDevice:
    """A device to store.

    Args:
        device: the device.
        sensors: its sensors.
        calibration: that of its traced optics; None where its lines are not read, as Gray tracks'.
    """

    device: NewDevice
    sensors: list[Sensor]
    calibration: Calibration | None


def device_id(profile_name: str) -> str:
    """Return the id of a profile's device: ids have no dots."""
    return profile_name.replace(".", "-")


def is_stored(session: Session, profile: DeviceProfile) -> bool:
    """Return whether the device of a profile is stored.

    Raises:
        InvalidParameter: its id is taken by a device of another source.
    """
    identity = device_id(profile.name)
    row = session.get(DeviceRow, identity)
    if row is None:
        return False
    source = source_of(row)
    if not isinstance(source, ProfileSource) or source.profile_id != profile.name:
        of = f"profile {source.profile_id}" if isinstance(source, ProfileSource) else source.kind
        raise InvalidParameter(
            f'name is "{profile.name}", and the device "{identity}" is there already with another '
            f"source ({of}); give the profile another name, or delete that device first",
            name=profile.name,
        )
    return True


def profile_device(profile: DeviceProfile) -> ProfileDevice:
    """Return the device of a profile; takes seconds.

    Its calibration is fitted to traced readings without noise of points all over the working
    volume; what the optics distort beyond the camera model stays in its residuals.

    Raises:
        InvalidParameter: it cannot be a device here, or does not see its volume well enough.
    """
    described = ProfileDriver(profile.name, profile, ProfileSettings()).description
    try:
        device = NewDevice(
            id=device_id(profile.name),
            title=profile.title[:200],
            source=ProfileSource(kind="profile", profile_id=profile.name),
        )
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise InvalidParameter(
            f"profile {profile.name}: {where} is {first['input']!r}: {first['msg']}", field=where
        ) from None
    sensors = validated_sensors(described.sensors)
    read = described.readout != "gray-tracks"
    calibration = nominal_calibration(profile) if read else None
    return ProfileDevice(device, sensors, calibration)


def store_profile_device(session: Session, device: ProfileDevice, file_hash: str) -> None:
    """Store a device with its calibration, ``ID-nominal``, as the active one.

    Args:
        session: the session.
        device: the device.
        file_hash: SHA-256 of its profile's file.

    Raises:
        DeviceExists, CalibrationExists.
    """
    identity, result = device.device.id, device.calibration
    add_device(session, device.device, device.sensors)
    if result is None:
        return
    assert isinstance(device.device.source, ProfileSource)
    profile = CalibratedProfile(profile_id=device.device.source.profile_id, content_hash=file_hash)
    note = nominal_note(profile.profile_id, file_hash, result)
    store_nominal(session, identity, result, note, profile)
