"""A profile's sensors as the world sees them: points in their frames, rays through their optics."""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from compute.optics.coded_aperture.coded_window import CodedWindow
from compute.optics.profiles.device_profile import DeviceProfile, PlateOptics, SensorProfile
from compute.optics.profiles.profile_loader import load_profile
from compute.optics.sensor_placement import place_sensor
from compute.optics.tracing.assembly import Assembly
from compute.optics.tracing.reference_tracer import RayStatus, TracedRays, trace_rays
from tests.compute.optics.profiles.ray_fans import field_of_view_rad, stop_of

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


def to_sensor_frame(sensor: SensorProfile, points_mm: Array) -> Array:
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
    """Trace rays of points (N, 3), in the sensor's frame, each through its place in the stop."""
    points = np.broadcast_to(seen_mm, (len(x_mm), 3))
    origins = points * [1.0, -1.0, -1.0]  # into the optics' frame: half a turn about x
    through = np.column_stack([x_mm, y_mm, np.full(len(x_mm), stop_of(assembly).z_mm)])
    return trace_rays(assembly.stack(), origins, through - origins)


def readings_mm(assembly: Assembly, seen_mm: Array, rays: int = 21) -> Array:
    """Where points (N, 3) are read, from the middle of the line, shape (N,) [mm]: the means of
    the rays that meet the line, whose places across the stop are found by their slope."""
    count, step = len(seen_mm), 0.01
    points = np.repeat(seen_mm, rays, axis=0)
    places = (np.arange(rays) + 0.5) / rays - 0.5
    x = np.tile(places * stop_of(assembly).aperture.width_mm, count)
    y = np.zeros(len(x))
    for _ in range(3):
        first, second = (
            through_stop(assembly, points, x, y + shift).position_mm[:, 1] for shift in (0.0, step)
        )
        y -= first * step / (second - first)
    traced = through_stop(assembly, points, x, y)
    assert (traced.status == RayStatus.ARRIVED).all()
    assert abs(traced.position_mm[:, 1]).max() < 0.01
    return -traced.position_mm[:, 0].reshape(count, rays).mean(axis=1)
