"""Stores the device of a profile, with the calibration that its traced optics give."""

from dataclasses import asdict
from typing import Final

import numpy as np
from pydantic import TypeAdapter
from sqlalchemy.orm import Session

from compute.calibration.result import Calibration
from compute.calibration.run import calibrate
from compute.camera.model import SensorGeometry
from compute.optics.profiles.build import profile_optics
from compute.optics.profiles.profile import DeviceProfile
from compute.planning.line_bound import centroids
from hardware.simulated.profile_driver import ProfileDriver, readout_of
from hardware.simulated.profile_settings import ProfileSettings
from service.calibrations.run import Outcome, calibration_content
from service.calibrations.schema import ControlPointErrors
from service.calibrations.store import activate, add_calibration
from service.database.models import DeviceRow
from service.devices.schema import NewDevice, ProfileSource, Sensor
from service.devices.store import add_device

_GRID: Final = 6  # control points along each side of the volume
_SENSORS: Final = TypeAdapter(list[Sensor])


def add_profile_device(session: Session, profile: DeviceProfile) -> bool:
    """Store the device of a profile under the profile's name, unless there is one.

    Its calibration is fitted to traced readings without noise of points all over the working
    volume; what the lenses distort beyond the camera model stays in its residuals. A device
    whose lines are not images of markers gets none.

    Returns:
        Whether it was stored.

    Raises:
        LumilineError: the sensors do not see their volume well enough.
    """
    if session.get(DeviceRow, profile.name) is not None:
        return False
    source = ProfileSource(kind="profile", profile=profile.name)
    described = ProfileDriver(profile.name, profile, ProfileSettings()).description
    sensors = _SENSORS.validate_python([asdict(sensor) for sensor in described.sensors])
    device = NewDevice(id=profile.name, title=profile.title[:200], source=source)
    add_device(session, device, sensors)
    if readout_of(profile) != "lines":
        return True
    result = nominal_calibration(profile)
    left_over = max(fit.rms_px for fit in result.sensors)
    note = (
        "Cameras fitted to the profile's traced optics over its working volume; nothing was "
        f"measured. The lenses' distortion beyond them is up to {left_over:.2g} px RMS."
    )
    content = calibration_content(profile.name, "nominal", [], result)
    errors = ControlPointErrors(fitted=None, leave_one_out=None)
    outcome = Outcome(result, content, errors.model_dump(mode="json"))
    identity = f"{profile.name}-nominal"
    add_calibration(session, profile.name, outcome, note, identity)
    activate(session, identity)
    return True


def nominal_calibration(profile: DeviceProfile) -> Calibration:
    """Return the cameras that fit the profile's traced optics best over its working volume.

    Raises:
        LumilineError: the sensors do not see their volume well enough; see ``calibrate``.
    """
    pixels = profile.pixels.count
    share = np.linspace(-0.5, 0.5, _GRID)
    grid = np.stack(np.meshgrid(share, share, share, indexing="ij"), axis=-1).reshape(-1, 3)
    points = np.array(profile.volume.centre_mm) + grid * np.array(profile.volume.size_mm)
    readings, light = centroids(profile_optics(profile, "exact").footprints(points), pixels)
    on_row = (readings >= -0.5) & (readings <= pixels - 0.5) & (light > 0.0)
    geometry = [SensorGeometry(sensor.name, pixels) for sensor in profile.sensors]
    return calibrate(points, np.where(on_row, readings, np.nan), geometry)
