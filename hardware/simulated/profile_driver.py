"""ProfileDriver: driver of a device simulated from its profile."""

from compute.optics.coded_aperture.coded_window import CodedWindow
from compute.optics.profiles.device_profile import DeviceProfile, PlateOptics
from hardware.driver import DeviceDescription, Readout, SensorDescription
from hardware.simulated.driver import RenderedDriver
from hardware.simulated.frame_batch import Timing
from hardware.simulated.profile_renderer import ProfileRenderer
from hardware.simulated.profile_settings import ProfileSettings


class ProfileDriver(RenderedDriver):
    """Simulated device with the optics, light and detector of a profile.

    Args:
        name: the device's name.
        profile: the device.
        settings: what it shows; see ``ProfileSettings``.

    Raises:
        InvalidParameter: the frame rate is above the profile's line rate.
    """

    def __init__(self, name: str, profile: DeviceProfile, settings: ProfileSettings) -> None:
        timing = Timing(
            settings.rate_of(profile),
            settings.strobed_in(profile),
            settings.duration_s,
            settings.realtime,
        )
        detector = profile.detector
        description = DeviceDescription(
            name=name,
            sensors=tuple(
                SensorDescription(sensor.name, profile.pixels.count, profile.pixels.pitch_um)
                for sensor in profile.sensors
            ),
            frame_rate_hz=timing.frame_rate_hz,
            bits=detector.bits,
            electrons_per_count=detector.electrons_per_count,
            read_noise_electrons=detector.read_noise_electrons,
            offset_counts=detector.offset_counts,
            markers=timing.strobed_markers,
            readout=readout_of(profile),
            peaks=settings.peaks,
            profile=profile.name,
        )
        super().__init__(description, ProfileRenderer(profile, settings, timing), timing)


def readout_of(profile: DeviceProfile) -> Readout:
    """Return the content of a scan of the profile's sensors."""
    kinds = {type(one) for one in profile.optics.values()}
    if CodedWindow in kinds:
        return "coded-window"
    return "gray-tracks" if PlateOptics in kinds else "lines"
