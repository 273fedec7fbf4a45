"""Nominal calibration of a profile: the cameras that fit its traced optics; nothing is measured."""

from typing import Any, Final

import numpy as np

from compute.calibration.calibrate import calibrate
from compute.calibration.result import Calibration
from compute.camera.model import SensorGeometry
from compute.errors import InvalidParameter, LumilineError
from compute.optics.coded_aperture.mask_optics import MaskOptics
from compute.optics.profiles.device_profile import DeviceProfile
from compute.optics.profiles.profile_loader import parse_profile
from compute.optics.profiles.profile_optics import profile_optics
from compute.planning.cramer_rao import centroids
from service.api.concurrency_limit import ConcurrencyLimit
from service.jobs.worker_process import call_in_process
from service.problems.errors import WorkerEnded

TIMEOUT_S: Final = 120.0
MEMORY_BYTES: Final = 4 * 1024**3

_limit = ConcurrencyLimit(
    1, "a nominal calibration is being computed; send this one again in a second"
)

_GRID: Final = 6  # control points along each side of the volume


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


def nominal_in_process(name: str, toml: str) -> Calibration:
    """Return the nominal calibration, computed in a process of its own: it is work of seconds.

    Args:
        name: the profile's name.
        toml: its file.

    Raises:
        InvalidParameter: as ``nominal_calibration``; it took too long or too much memory.
        Busy: another one is being computed.
    """
    try:
        with _limit:
            found: Calibration = call_in_process(
                _compute, name, toml, timeout_s=TIMEOUT_S, memory_bytes=MEMORY_BYTES
            )
    except WorkerEnded as error:
        raise InvalidParameter(
            f"the nominal calibration of profile {name} could not be computed within "
            f"{TIMEOUT_S:g} s and {MEMORY_BYTES} bytes of memory: {error.detail}",
            profile_id=name,
        ) from error
    return found


def _compute(_tell: Any, name: str, toml: str) -> Calibration:
    return nominal_calibration(parse_profile(toml, origin=name))


def nominal_note(profile_name: str, profile_hash: str, calibration: Calibration) -> str:
    """Return what a person is to know of a nominal calibration."""
    residual_rms = max(fit.rms_px for fit in calibration.sensors)
    return (
        f'Cameras fitted to the traced optics of the profile "{profile_name}" (SHA-256 of its file '
        f"{profile_hash[:12]}...) over its working volume; nothing was measured. Right for the "
        "device that is simulated from it, and for no device that was built. The optics' "
        f"distortion beyond them is up to {residual_rms:.2g} px RMS."
    )
