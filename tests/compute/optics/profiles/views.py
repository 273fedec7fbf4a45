"""A profile's sensors as the world sees them: points in their frames, rays through their optics."""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from compute.optics.masks.window import CodedWindow
from compute.optics.placement import place_sensor
from compute.optics.profiles.loader import load_profile
from compute.optics.profiles.profile import DeviceProfile, PlateOptics, SensorProfile
from compute.optics.tracing.assembly import Assembly
from compute.optics.tracing.rays import RayStatus, TracedRays
from compute.optics.tracing.trace import trace_rays
from tests.compute.optics.profiles.fans import field_of_view_rad, stop_of

Array = NDArray[np.float64]


def lenses(profile: DeviceProfile, sensor: SensorProfile) -> Assembly | None:
    """The lenses before a sensor; None before a coded window."""
    optics = profile.optics[sensor.optics]
    if isinstance(optics, CodedWindow):
        return None
    return optics.assembly if isinstance(optics, PlateOptics) else optics


def line_mm(profile: DeviceProfile, sensor: SensorProfile) -> float:
    """Length on which the sensor reads."""
    optics = profile.optics[sensor.optics]
    return optics.plate.length_mm if isinstance(optics, PlateOptics) else profile.pixels.length_mm


def in_sensor_frame(sensor: SensorProfile, points_mm: Array) -> Array:
    """Points in the frame with x along the measured direction and z towards the aim."""
    model = place_sensor(
        sensor.name,
        lens_position_mm=sensor.position_mm,
        aim_mm=sensor.aim_mm,
        measured_direction=sensor.measured_direction,
        principal_distance_mm=1.0,
        pixels=1,
        pitch_um=1000.0,
    ).model
    return (points_mm - np.array(sensor.position_mm)) @ model.rotation.T


def distance_mm(profile: DeviceProfile, sensor: SensorProfile) -> float:
    return float(np.linalg.norm(np.subtract(profile.volume.centre_mm, sensor.position_mm)))


@cache
def half_field(name: str) -> float:
    """Tangent of half the field of view of a profile's first sensor; all have the same optics."""
    profile = load_profile(name)
    sensor = profile.sensors[0]
    optics = profile.optics[sensor.optics]
    if isinstance(optics, CodedWindow):  # the pixels see the code and nothing but the code
        assert optics.plate_thickness_mm < optics.gap_mm
        return (optics.length_mm - line_mm(profile, sensor)) / 2.0 / optics.gap_mm
    assembly = lenses(profile, sensor)
    assert assembly is not None
    full = field_of_view_rad(assembly, line_mm(profile, sensor), distance_mm(profile, sensor))
    return float(np.tan(full / 2.0))


def through_stop(assembly: Assembly, seen_mm: Array, x_mm: Array, y_mm: Array) -> TracedRays:
    """Trace rays of one point, in the sensor's frame, through places in the stop."""
    stop = stop_of(assembly)
    point = seen_mm * [1.0, -1.0, -1.0]  # into the optics' frame: half a turn about x
    through = np.column_stack([x_mm, y_mm, np.full(len(x_mm), stop.z_mm)])
    return trace_rays(assembly.stack(), np.tile(point, (len(x_mm), 1)), through - point)


def reading_mm(assembly: Assembly, seen_mm: Array, rays: int = 21) -> float:
    """Where a point is read, from the middle of the line [mm]: the mean of the rays that meet
    the line, whose places across the stop are found by their slope."""
    x = ((np.arange(rays) + 0.5) / rays - 0.5) * stop_of(assembly).aperture.width_mm
    y, step = np.zeros(rays), 0.01
    for _ in range(3):
        traced = through_stop(assembly, seen_mm, np.tile(x, 2), np.append(y, y + step))
        first, second = np.split(traced.position_mm[:, 1], 2)
        y -= first * step / (second - first)
    traced = through_stop(assembly, seen_mm, x, y)
    assert (traced.status == RayStatus.ARRIVED).all()
    assert abs(traced.position_mm[:, 1]).max() < 0.01
    return -float(traced.position_mm[:, 0].mean())
