"""Optics, markers and shadow templates that a profile describes."""

from collections.abc import Sequence
from itertools import product
from typing import Final, Literal, get_args

import numpy as np

from compute.camera.model import vector3
from compute.errors import InvalidParameter
from compute.optics.coded_aperture.coded_window import CodedWindow
from compute.optics.coded_aperture.gray_plate import GrayPlate, TrackOptics
from compute.optics.coded_aperture.mask_optics import MaskOptics
from compute.optics.coded_aperture.template_from_optics import template_from_optics
from compute.optics.light.emission import CosinePower, EvenEmission
from compute.optics.light.led import Led
from compute.optics.light.light_source import LightSource
from compute.optics.light.retroreflector import Illuminator, RetroDisc, RetroSheet
from compute.optics.pixel_row import PixelRow
from compute.optics.pixel_solid_angles import SolidAngleOptics
from compute.optics.profiles.device_profile import DeviceProfile, PlateOptics
from compute.optics.profiles.profile_sections import LedMarkers
from compute.optics.sensor_placement import OpticalSensor, place_optics, place_sensor
from compute.optics.stripe_optics.stripe_profile import Blur
from compute.optics.stripe_optics.stripe_table import FieldOfView
from compute.optics.stripe_optics.tabulated_optics import MakeTable, TabulatedOptics
from compute.optics.stripe_optics.traced_stripes import ExactOptics
from compute.optics.tracing.assembly import Assembly
from compute.signal.coded_aperture.shadow_template import ShadowTemplate

OpticsMode = Literal["tabulated", "exact"]

_MARGIN: Final = 0.02  # of the tables beyond the volume, relative or in tangents

_NEAREST_MM: Final = 50.0


def pixel_row(profile: DeviceProfile) -> PixelRow:
    """Return the row of pixels of every sensor; a Gray plate's steps, where it has one.

    Raises:
        InvalidParameter: plates of several lengths or resolutions.
    """
    plate = gray_plate(profile)
    if plate is None:
        return profile.pixels
    return PixelRow(2**plate.bits, plate.step_mm * 1e3, profile.pixels.height_um)


def gray_plate(profile: DeviceProfile) -> GrayPlate | None:
    """Return the Gray plate before every sensor's detectors; None: it has none.

    Raises:
        InvalidParameter: plates of several lengths or resolutions.
    """
    plates = {one.plate for one in profile.optics.values() if isinstance(one, PlateOptics)}
    if len(plates) > 1:
        raise InvalidParameter(
            f"profile {profile.name} has {len(plates)} different plates; all must be the same",
            optics=sorted(profile.optics),
        )
    return plates.pop() if plates else None


def lens_sensors(profile: DeviceProfile, row: PixelRow) -> tuple[OpticalSensor, ...]:
    """Return the placed sensors of a profile with lenses.

    Args:
        profile: the device.
        row: the row of pixels of every sensor.

    Raises:
        InvalidParameter: a sensor has a coded window.
    """
    return tuple(
        place_optics(
            sensor.name,
            position_mm=sensor.position_mm,
            aim_mm=sensor.aim_mm,
            measured_direction=sensor.measured_direction,
            assembly=_assembly(profile, sensor.optics),
            row=row,
        )
        for sensor in profile.sensors
    )


def mask_optics(profile: DeviceProfile, source: LightSource) -> MaskOptics | None:
    """Return the optics of a profile with coded windows; None: it has none.

    Args:
        profile: the device.
        source: the markers' light.

    Raises:
        InvalidParameter: some sensors have a window and others not, or other windows.
    """
    windows = {one for one in profile.optics.values() if isinstance(one, CodedWindow)}
    if not windows:
        return None
    if len(windows) > 1 or len(profile.optics) > 1:
        raise InvalidParameter(
            f"profile {profile.name} has {len(profile.optics)} kinds of optics with coded windows "
            "among them; the window must be the same before all sensors",
            optics=sorted(profile.optics),
        )
    window = windows.pop()
    placed = [
        place_sensor(
            sensor.name,
            lens_position_mm=sensor.position_mm,
            aim_mm=sensor.aim_mm,
            measured_direction=sensor.measured_direction,
            principal_distance_mm=window.gap_mm,
            pixels=profile.pixels.count,
            pitch_um=profile.pixels.pitch_um,
        )
        for sensor in profile.sensors
    ]
    return MaskOptics(
        window,
        placed,
        pixel_height_mm=profile.pixels.height_um * 1e-3,
        emitter_width_mm=source.width_mm,
        wavelength_nm=source.wavelength_nm,
        spectral_width_nm=source.spectral_width_nm,
    )


def light_source(profile: DeviceProfile) -> LightSource:
    """Return the profile's markers as a source of light."""
    markers = profile.markers
    if isinstance(markers, LedMarkers):
        return Led(
            markers.radiant_intensity_w_per_sr,
            markers.wavelength_nm,
            CosinePower(markers.half_angle_rad),
            markers.spectral_width_nm,
            markers.emitter_width_mm,
        )
    towards = np.subtract(profile.volume.centre_mm, markers.illuminator_position_mm)
    lamp = Illuminator(
        markers.illuminator_position_mm,
        vector3(towards),
        markers.illuminator_intensity_w_per_sr,
        EvenEmission(),  # the profile's intensity is that towards the markers
        markers.wavelength_nm,
        markers.spectral_width_nm,
    )
    # The profile's half angle holds the cosine, the sheet's is beside it:
    # 2^-(h/s)^2 cos(h) = 1/2.
    half = markers.half_angle_rad
    beside_cosine = half / np.sqrt(np.log2(2.0 * np.cos(half)))
    sheet = RetroSheet(
        markers.retroreflection_per_sr, markers.observation_half_angle_rad, float(beside_cosine)
    )
    return RetroDisc(markers.diameter_mm, sheet, lamp)


def _assembly(profile: DeviceProfile, name: str) -> Assembly:
    optics = profile.optics[name]
    if isinstance(optics, CodedWindow):
        raise InvalidParameter(
            f"optics {name} of profile {profile.name} is a coded window; lenses are needed here",
            optics=name,
        )
    return optics.assembly if isinstance(optics, PlateOptics) else optics


def profile_field(profile: DeviceProfile, sensors: Sequence[OpticalSensor]) -> FieldOfView:
    """Return the part of the sensors' fields of view that holds the whole working volume.

    Args:
        profile: the device.
        sensors: its sensors, placed.
    """
    centre, half = np.array(profile.volume.centre_mm), np.array(profile.volume.size_mm) / 2.0
    corners = centre + half * np.array(list(product((-1, 1), repeat=3)))
    corners_in_sensor = np.concatenate([sensor.to_sensor_frame(corners) for sensor in sensors])
    front = max(-sensor.assembly.front_z_mm for sensor in sensors)
    # A volume may begin at the device itself; what is nearer than this is traced.
    depth = np.maximum(corners_in_sensor[:, 2], 2.0 * front + _NEAREST_MM)
    low = (corners_in_sensor[:, :2] / depth[:, None]).min(axis=0) - _MARGIN
    high = (corners_in_sensor[:, :2] / depth[:, None]).max(axis=0) + _MARGIN
    return FieldOfView(
        (float(low[0]), float(high[0])),
        (float(low[1]), float(high[1])),
        (float(depth.min()) * (1.0 - _MARGIN), float(depth.max()) * (1.0 + _MARGIN)),
    )


def profile_optics(
    profile: DeviceProfile, mode: OpticsMode, make_table: MakeTable | None = None
) -> SolidAngleOptics:
    """Return the optics of all sensors; pixels are the tracks' detectors, where it has a plate.

    Args:
        profile: the device.
        mode: "exact" traces every ray of every point; "tabulated" traces the working volume
            once (seconds) and interpolates from then on. A coded window is worked out in
            closed form in both.
        make_table: traces a table that is not kept from before; None: in this thread.

    Raises:
        InvalidParameter: optics of several kinds, or an unknown mode.
    """
    if mode not in get_args(OpticsMode):
        raise InvalidParameter(
            f'optics mode is "{mode}"; it must be one of {", ".join(get_args(OpticsMode))}',
            mode=mode,
        )
    source = light_source(profile)
    window = mask_optics(profile, source)
    if window is not None:
        return window
    sensors = lens_sensors(profile, pixel_row(profile))
    blur = Blur(source.wavelength_nm, source.width_mm)
    stripes: SolidAngleOptics = (
        ExactOptics(sensors, blur)
        if mode == "exact"
        else TabulatedOptics(sensors, blur, profile_field(profile, sensors), make_table=make_table)
    )
    plate = gray_plate(profile)
    return stripes if plate is None else TrackOptics(stripes, plate)


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
