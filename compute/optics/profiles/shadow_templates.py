"""Shadows of a profile's coded windows, as the readers of shadows want them."""

import numpy as np

from compute.optics.coded_aperture.template_from_optics import template_from_optics
from compute.optics.profiles.device_profile import DeviceProfile
from compute.optics.profiles.profile_optics import light_source, mask_optics
from compute.signal.coded_aperture.shadow_template import ShadowTemplate


def window_shadows(profile: DeviceProfile) -> tuple[ShadowTemplate, ...]:
    """Return the shadow of a marker in the middle of the volume on each sensor.

    Empty where the profile has no coded windows. Takes tenths of a second.
    """
    optics = mask_optics(profile, light_source(profile))
    if optics is None:
        return ()
    return tuple(
        template_from_optics(
            optics,
            np.array(profile.volume.centre_mm),
            sensor=number,
            direction=sensor.measured_direction,
        )
        for number, sensor in enumerate(profile.sensors)
    )
