"""Profile of a tracking device: geometry, optics, detector, markers, rates."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from compute.camera.model import Vector3
from compute.errors import InvalidParameter
from compute.optics.coded_aperture.coded_window import CodedWindow
from compute.optics.coded_aperture.gray_plate import GrayPlate
from compute.optics.pixel_row import PixelRow
from compute.optics.profiles.error_sources import ErrorSources
from compute.optics.profiles.profile_sections import (
    DetectorProfile,
    Markers,
    PublishedFigure,
    Rates,
    Volume,
)
from compute.optics.sensor_placement import sensor_rotation
from compute.optics.tracing.assembly import Assembly


@dataclass(frozen=True)
class PlateOptics:
    """Lenses that image a stripe of light across a plate with Gray tracks (section 2.3).

    Args:
        assembly: the lenses; its sensor stands for the plate.
        plate: the tracks, a detector behind each.
    """

    assembly: Assembly
    plate: GrayPlate


Optics = Assembly | CodedWindow | PlateOptics


@dataclass(frozen=True)
class SensorProfile:
    """Position and orientation of one line sensor.

    The frame of its assembly has its origin at ``position_mm``, its z axis, which goes with the
    light, away from ``aim_mm``, and its x axis along ``measured_direction`` made perpendicular
    to z. The image is upside down, so the pixels are counted against x.
    A coded window has its own frame: the origin in the middle of the code, z towards the aim.

    Args:
        name: the sensor's name in its device.
        position_mm: origin of its optics' frame in the world [mm].
        aim_mm: a point on its optical axis, in front of it [mm].
        measured_direction: world direction along which readings grow; any length.
        optics: name of its optics in the profile.

    Raises:
        InvalidParameter: it is aimed at itself, or measures along its own axis.
    """

    name: str
    position_mm: Vector3
    aim_mm: Vector3
    measured_direction: Vector3
    optics: str

    def __post_init__(self) -> None:
        sensor_rotation(self.name, self.position_mm, self.aim_mm, self.measured_direction)


@dataclass(frozen=True)
class DeviceProfile:
    """A device: geometry, optics, detector, markers, rates, volume, published figures.

    The world frame is right-handed with its origin in the middle of the device: X along the bar,
    Y up, Z from the device into the volume.

    Args:
        name: short name.
        title: what it is, in words.
        sources: where it is described.
        sensors: its line sensors, in the order of the device's lines.
        optics: by name, what stands before the sensors.
        pixels: of every sensor.
        detector: of every sensor.
        markers: what it tracks.
        rates: of its lines.
        volume: where it tracks.
        year: of its publication, where known.
        published: published figures; none where none were.
        notes: what else must be known, such as how the source's axes map to ours.
        assumed: dotted paths of what the sources leave open, each with the reason for its value.
        error_sources: what makes it inaccurate besides noise, as far as it is known.

    Raises:
        InvalidParameter: no sensor, a name given twice, optics that are not there or not used,
            another number of pixels than a plate has tracks, errors of other sensors.
    """

    name: str
    title: str
    sources: tuple[str, ...]
    sensors: tuple[SensorProfile, ...]
    optics: Mapping[str, Optics]
    pixels: PixelRow
    detector: DetectorProfile
    markers: Markers
    rates: Rates
    volume: Volume
    year: int | None = None
    published: tuple[PublishedFigure, ...] = ()
    notes: tuple[str, ...] = ()
    assumed: Mapping[str, str] = field(default_factory=dict)
    error_sources: ErrorSources = field(default_factory=ErrorSources)

    def __post_init__(self) -> None:
        if not self.sensors:
            raise InvalidParameter("sensors is empty; give at least one", sensors=())
        names = [sensor.name for sensor in self.sensors]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise InvalidParameter(
                f"sensors has two named {', '.join(twice)}; each needs a name of its own",
                sensors=names,
            )
        used = {sensor.optics for sensor in self.sensors}
        if missing := sorted(used - set(self.optics)):
            raise InvalidParameter(
                f"sensors use the optics {', '.join(missing)}; the profile has "
                f"{', '.join(sorted(self.optics)) or 'none'}",
                sensors=missing,
            )
        if unused := sorted(set(self.optics) - used):
            raise InvalidParameter(
                f"optics has {', '.join(unused)}, which no sensor uses; leave it out",
                optics=unused,
            )
        stated = self.error_sources.uncorrected_distortion_px
        if stated is not None and len(stated) != len(self.sensors):
            raise InvalidParameter(
                f"error_sources.uncorrected_distortion has {len(stated)} values; give one for each "
                f"of the {len(self.sensors)} sensors",
                error_sources=stated,
            )
        for name, one in self.optics.items():
            if isinstance(one, PlateOptics) and one.plate.tracks != self.pixels.count:
                raise InvalidParameter(
                    f"pixels has the count {self.pixels.count}; the plate of the optics {name} has "
                    f"{one.plate.tracks} tracks, with a detector behind each",
                    pixels=self.pixels.count,
                )

    @property
    def limitations(self) -> tuple[str, ...]:
        """Functions that a device of this profile does not have here, one sentence each."""
        if not any(isinstance(one, PlateOptics) for one in self.optics.values()):
            return ()
        sentence = (
            "The outputs of the Gray tracks are simulated and not decoded: a device of this "
            "profile streams frames without peaks, points, tracks or tools, and cannot be "
            "calibrated."
        )
        return (sentence,)
