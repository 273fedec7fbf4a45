"""Settings of the driver of a profile's simulated device."""

from dataclasses import dataclass
from typing import Annotated, Final, Literal

from pydantic import Field

from compute.errors import InvalidParameter
from compute.optics.coded_aperture.coded_window import CodedWindow
from compute.optics.profiles.device_profile import DeviceProfile
from compute.optics.profiles.profile_optics import OpticsMode
from hardware.driver import PeakMethod
from hardware.field_bounds import CheckedSettings
from hardware.simulated.scenes import RotatingBar, Scene

MAX_RATE_HZ: Final = 1000.0
"""Default upper limit of the frame rate, which any host can process."""

MAX_SHADOW_RATE_HZ: Final = 100.0
"""The same with coded windows, whose shadows take milliseconds to compute."""

_BAR_LENGTH_FRACTION: Final = 0.5  # of the volume's smallest side, in the default scene


@dataclass(frozen=True)
class ProfileSettings(CheckedSettings):
    """What a profile's device shows, and how it is simulated.

    Geometry, optics, markers' light, detector and exposure are the profile's.

    Args:
        scene: the markers and their motion; None: a bar that turns in the middle of the volume.
        optics: "tabulated" interpolates between exact traces, for live use; "exact" traces every
            ray of every frame, too slowly for live use.
        frame_rate_hz: exposures per second; None: the profile's line rate, at most 1000, or 100
            with coded windows.
        illumination: "strobed" or "simultaneous"; None: as the profile says.
        seed: seed of the noise.
        pattern_seed: seed of the pixels' differences: another device of the kind.
        peaks: "fit" measures the lines' peaks by a fit of their shape, "centroid" by threshold and
            centre of gravity.
        duration_s: length of the scene [s], at least one exposure; None: endless.
        realtime: True: a frame is delivered when it is exposed; False: as soon as it is asked
            for. The lines are the same.

    Raises:
        InvalidParameter: a value is outside of its bounds.
    """

    scene: Scene | None = None
    optics: OpticsMode = "tabulated"
    frame_rate_hz: Annotated[float, Field(ge=0.01, le=10_000.0)] | None = None
    illumination: Literal["strobed", "simultaneous"] | None = None
    seed: Annotated[int, Field(ge=0, le=2**32 - 1)] = 1
    pattern_seed: Annotated[int, Field(ge=0, le=2**32 - 1)] = 1
    peaks: PeakMethod = "fit"
    duration_s: Annotated[float, Field(gt=0.0, le=1e7)] | None = None
    realtime: bool = True

    def scene_in(self, profile: DeviceProfile) -> Scene:
        """Return the scene; default: a rotating bar in the centre of the profile's volume."""
        if self.scene is not None:
            return self.scene
        volume = profile.volume
        return RotatingBar(
            length_mm=_BAR_LENGTH_FRACTION * min(volume.size_mm), centre_mm=volume.centre_mm
        )

    def rate_of(self, profile: DeviceProfile) -> float:
        """Return the frame rate [Hz].

        Raises:
            InvalidParameter: it is above the profile's line rate.
        """
        fastest = profile.rates.line_rate_hz
        if self.frame_rate_hz is None:
            shadows = any(isinstance(one, CodedWindow) for one in profile.optics.values())
            return min(fastest, MAX_SHADOW_RATE_HZ if shadows else MAX_RATE_HZ)
        if self.frame_rate_hz > fastest:
            raise InvalidParameter(
                f"frame_rate_hz is {self.frame_rate_hz}; {profile.name} reads at most "
                f"{fastest:g} lines per second",
                frame_rate_hz=self.frame_rate_hz,
            )
        return self.frame_rate_hz

    def strobed_in(self, profile: DeviceProfile) -> int:
        """Return the number of strobed markers, 0 when they are lit together."""
        illumination = self.illumination or profile.markers.illumination
        return self.scene_in(profile).markers if illumination == "strobed" else 0
