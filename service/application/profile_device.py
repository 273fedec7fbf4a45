"""Makes the device of a profile, with the calibration of its traced optics."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from pydantic import ValidationError
from sqlalchemy.orm import Session

from compute.calibration.calibrate import calibrate
from compute.calibration.result import Calibration
from compute.camera.model import SensorGeometry
from compute.errors import InvalidParameter, LumilineError
from compute.optics.coded_aperture.mask_optics import MaskOptics
from compute.optics.profiles.device_profile import DeviceProfile
from compute.optics.profiles.profile_optics import profile_optics
from compute.planning.cramer_rao import centroids
from hardware.simulated.profile_driver import ProfileDriver
from hardware.simulated.profile_settings import ProfileSettings
from service.api.devices.driver_factory import validated_sensors
from service.api.devices.schema import NewDevice, ProfileSource, Sensor
from service.api.devices.store import add_device, source_of
from service.application.initial_content import store_nominal
from service.database.models import DeviceRow

_GRID: Final = 6  # control points along each side of the volume


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


def store_profile_device(session: Session, device: ProfileDevice) -> None:
    """Store a device with its calibration, ``ID-nominal``, as the active one.

    Raises:
        DeviceExists, CalibrationExists.
    """
    identity, result = device.device.id, device.calibration
    add_device(session, device.device, device.sensors)
    if result is None:
        return
    residual_rms = max(fit.rms_px for fit in result.sensors)
    note = (
        "Cameras fitted to the profile's traced optics over its working volume; nothing was "
        f"measured. The optics' distortion beyond them is up to {residual_rms:.2g} px RMS."
    )
    store_nominal(session, identity, result, note)


def nominal_calibration(profile: DeviceProfile) -> Calibration:
    """Return the cameras that fit the profile's traced optics best over its working volume.

    A reading is a whole light line's centre of gravity, or where the shadow of the middle of a
    window's code falls.

    Raises:
        InvalidParameter: the sensors do not see their volume well enough.
    """
    pixels = profile.pixels.count
    share = np.linspace(-0.5, 0.5, _GRID)
    grid = np.stack(np.meshgrid(share, share, share, indexing="ij"), axis=-1).reshape(-1, 3)
    points = np.array(profile.volume.centre_mm) + grid * np.array(profile.volume.size_mm)
    optics = profile_optics(profile, "exact")
    if isinstance(optics, MaskOptics):
        readings = optics.readings(points)
        on_row = (readings >= -0.5) & (readings <= pixels - 0.5)
    else:
        readings, light = centroids(optics.solid_angles(points), pixels)
        on_row = (readings >= -0.5) & (readings <= pixels - 0.5) & (light > 0.0)
    geometry = [SensorGeometry(sensor.name, pixels) for sensor in profile.sensors]
    try:
        return calibrate(points, np.where(on_row, readings, np.nan), geometry)
    except LumilineError as error:
        raise InvalidParameter(
            f"profile {profile.name}: its sensors do not see the volume well enough to be "
            f"calibrated in it: {error.detail}; change the volume, or where the sensors are aimed",
            field="volume",
        ) from None
