"""ExpectedScans: noiseless scans and shadow templates of a device, from its profile."""

import logging
from collections.abc import Callable
from dataclasses import dataclass

from compute.errors import LumilineError
from compute.optics.profiles.device_profile import DeviceProfile
from compute.optics.profiles.profile_loader import load_profile, profile_names
from compute.optics.profiles.profile_optics import window_shadows
from compute.planning.volume_scans import VolumeScans, volume_scans
from compute.signal.coded_aperture.shadow_template import ShadowTemplate
from hardware.driver import DeviceDescription
from service.problems.errors import UnknownDeviceProfile

_log = logging.getLogger(__name__)

FindProfile = Callable[[str], DeviceProfile]


@dataclass(frozen=True, eq=False)
class ExpectedScans:
    """What the profile adds to a device's description for the measurement of peaks.

    Args:
        volume: noiseless light lines of its volume with their true readings; None: not known.
        templates: shadows of its coded windows, by sensor; empty where it has none.
    """

    volume: VolumeScans | None = None
    templates: tuple[ShadowTemplate, ...] = ()


def built_in_profile(name: str) -> DeviceProfile:
    """Return a built-in profile; a recording's name for one is no path.

    Raises:
        UnknownDeviceProfile: there is none of the name.
    """
    if name not in profile_names():
        raise UnknownDeviceProfile(
            f'there is no built-in device profile "{name}"; there are {", ".join(profile_names())}',
            name=name,
        )
    return load_profile(name)


def expected_scans(
    description: DeviceDescription, find_profile: FindProfile = built_in_profile
) -> ExpectedScans:
    """Return the expected scans of a device; takes tenths of a second, and no Warp.

    They are empty for a profile that is gone, or of another device meanwhile; the log says so.
    """
    if description.profile is None or description.readout == "gray-tracks":
        return ExpectedScans()
    try:
        profile = find_profile(description.profile)
        if not _is_of(profile, description):
            _log.warning("device %s: profile %s is of other sensors, and not used",
                         description.name, profile.name)  # fmt: skip
            return ExpectedScans()
        if description.readout == "coded-window":
            return ExpectedScans(templates=window_shadows(profile))
        return ExpectedScans(volume_scans(profile))
    except LumilineError as error:
        _log.warning("device %s: its profile tells nothing of its lines: %s",
                     description.name, error.detail)  # fmt: skip
        return ExpectedScans()


def _is_of(profile: DeviceProfile, description: DeviceDescription) -> bool:
    pixels = {sensor.pixels for sensor in description.sensors}
    names = [sensor.name for sensor in description.sensors]
    return names == [sensor.name for sensor in profile.sensors] and pixels == {profile.pixels.count}
