"""The built-in profiles work as optics: they see their volume, are in focus, and get light."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.optics.coded_aperture.coded_window import CodedWindow
from compute.optics.light.retroreflector import RetroDisc
from compute.optics.profiles.device_profile import DeviceProfile, PlateOptics
from compute.optics.profiles.profile_loader import load_profile, profile_names
from compute.optics.profiles.profile_optics import light_source
from compute.optics.profiles.profile_sections import LedMarkers, RetroMarkers
from tests.compute.optics.profiles.ray_fans import fan, stop_of
from tests.compute.optics.profiles.sensor_views import (
    distance_mm,
    half_field,
    lenses,
    line_mm,
    readings_mm,
    through_stop,
    to_sensor_frame,
)

WITH_LENSES = [
    name
    for name in profile_names()
    if not any(isinstance(optics, CodedWindow) for optics in load_profile(name).optics.values())
]
STATED_FOCUS = {"thesis-5.1", "thesis-5.2"}  # Appendix E says 37 mm, which is not the best focus

PLANCK_TIMES_C = 6.62607015e-34 * 299792458.0  # J m


@pytest.mark.parametrize("name", WITH_LENSES)
def test_every_sensor_reads_the_middle_of_the_volume(name: str) -> None:
    profile = load_profile(name)
    for sensor in profile.sensors:
        assembly = lenses(profile, sensor)
        assert assembly is not None
        seen = to_sensor_frame(sensor, np.array([profile.volume.centre_mm]))
        assert abs(readings_mm(assembly, seen)) < line_mm(profile, sensor) / 2.0


@pytest.mark.parametrize("name", WITH_LENSES)
def test_readings_grow_along_the_measured_direction(name: str) -> None:
    profile = load_profile(name)
    for sensor in profile.sensors:
        assembly = lenses(profile, sensor)
        assert assembly is not None
        centre = np.array(profile.volume.centre_mm)
        step = 10.0 * np.array(sensor.measured_direction)
        seen = to_sensor_frame(sensor, np.stack([centre - step, centre + step]))
        before, after = readings_mm(assembly, seen)
        assert after > before


def corners(profile: DeviceProfile) -> np.ndarray:
    half = np.array(profile.volume.size_mm) / 2.0
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    return np.array(profile.volume.centre_mm) + half * signs


@pytest.mark.parametrize("name", WITH_LENSES)
def test_every_sensor_reads_the_corners_of_the_volume(name: str) -> None:
    profile = load_profile(name)
    for sensor in profile.sensors:
        assembly = lenses(profile, sensor)
        assert assembly is not None
        # Fails inside, too, where some of the stop's light does not reach the line.
        found = readings_mm(assembly, to_sensor_frame(sensor, corners(profile)), rays=9)
        assert abs(found).max() < line_mm(profile, sensor) / 2.0


def test_every_window_fills_its_pixels_with_code_from_the_corners_of_the_volume() -> None:
    profile = load_profile("coda-mpx30")
    for sensor in profile.sensors:
        seen = to_sensor_frame(sensor, corners(profile))
        assert abs(seen[:, 0] / seen[:, 2]).max() < half_field(profile.name)


@pytest.mark.parametrize("name", WITH_LENSES)
def test_lines_are_narrow_over_the_field_and_all_light_of_the_stop_arrives(name: str) -> None:
    profile = load_profile(name)
    sensor = profile.sensors[0]
    optics = profile.optics[sensor.optics]
    assembly = lenses(profile, sensor)
    assert assembly is not None
    step = (
        optics.plate.cell_mm if isinstance(optics, PlateOptics) else profile.pixels.pitch_um / 1e3
    )
    angles = np.arctan(np.linspace(0.0, 0.98, 9) * half_field(name))
    fans = [fan(assembly, angle, distance_mm(profile, sensor)) for angle in angles]
    assert min(one.arrived for one in fans) == 1.0
    widest = max(one.width_mm() for one in fans) / step
    assert widest < (16.0 if name in STATED_FOCUS else 4.0)


@pytest.mark.parametrize("name", [name for name in WITH_LENSES if name not in STATED_FOCUS])
def test_the_sensor_stands_where_lines_are_narrowest_over_the_field(name: str) -> None:
    profile = load_profile(name)
    sensor = profile.sensors[0]
    assembly = lenses(profile, sensor)
    assert assembly is not None
    angles = np.arctan(np.linspace(0.0, 0.98, 9) * half_field(name))
    fans = [fan(assembly, angle, distance_mm(profile, sensor)) for angle in angles]

    def square(shift_mm: float) -> float:
        return float(np.mean([one.width_mm(shift_mm) ** 2 for one in fans]))

    # The mean square is a parabola of the shift.
    left, here, right = square(-0.5), square(0.0), square(0.5)
    best = here - (right - left) ** 2 / (8.0 * (left - 2.0 * here + right))
    assert np.sqrt(here / best) < 1.03


@pytest.mark.parametrize("name", WITH_LENSES)
def test_a_marker_in_the_middle_gives_ten_thousand_to_a_million_electrons(name: str) -> None:
    profile = load_profile(name)
    markers = profile.markers
    assert isinstance(markers, LedMarkers)
    for sensor in profile.sensors:
        assembly = lenses(profile, sensor)
        assert assembly is not None
        distance = distance_mm(profile, sensor)
        stop = stop_of(assembly)
        # The strip of the stop whose light falls on the height of a pixel, by two rays.
        traced = through_stop(
            assembly, np.array([0.0, 0.0, distance]), np.zeros(2), np.array([0.0, 0.1])
        )
        slope = np.diff(traced.position_mm[:, 1])[0] / 0.1
        strip = profile.pixels.height_um * 1e-3 / abs(slope)
        passed = float(traced.transmittance[0].mean())
        solid_angle = stop.aperture.width_mm * strip / (distance + stop.z_mm) ** 2 * passed
        photons = (
            markers.radiant_intensity_w_per_sr
            * profile.rates.exposure_s
            * markers.wavelength_nm
            * 1e-9
            / PLANCK_TIMES_C
        )
        electrons = photons * solid_angle * profile.detector.quantum_efficiency
        assert 1e4 < electrons < 1e6


@pytest.mark.parametrize("name", profile_names())
def test_the_detector_can_be_built_and_its_converter_covers_the_full_well(name: str) -> None:
    profile = load_profile(name)
    detector = profile.detector.detector(profile.rates.exposure_s)
    assert detector.dark_electrons == pytest.approx(
        profile.detector.dark_current_electrons_per_s * profile.rates.exposure_s
    )
    top = detector.full_scale * detector.electrons_per_count
    assert 0.7 < top / detector.full_well_electrons < 1.5
    background = detector.ambient_electrons + detector.dark_electrons
    assert background < 0.05 * detector.full_well_electrons


def test_a_coda_pixel_gets_thousands_of_electrons() -> None:
    profile = load_profile("coda-mpx30")
    markers = profile.markers
    assert isinstance(markers, LedMarkers)
    pixel = profile.pixels.pitch_um * profile.pixels.height_um * 1e-6  # mm2
    solid_angle = pixel / distance_mm(profile, profile.sensors[0]) ** 2
    photons = (
        markers.radiant_intensity_w_per_sr
        * profile.rates.exposure_s
        * markers.wavelength_nm
        * 1e-9
        / PLANCK_TIMES_C
    )
    electrons = photons * solid_angle * profile.detector.quantum_efficiency
    assert 1e3 < electrons < 0.5 * profile.detector.full_well_electrons


@settings(max_examples=50, deadline=None)
@given(half_angle_rad=st.floats(1e-3, np.pi / 3.0, exclude_max=True))
def test_a_retroreflector_sends_half_back_at_its_half_angle(half_angle_rad: float) -> None:
    """By the light of a disc turned away from lamp and sensor, which are in one place."""
    markers = RetroMarkers(
        2.0, (0.0, 0.0, 0.0), 880.0, 50.0, 500.0, 0.01, half_angle_rad, 12.0, 8
    )  # fmt: skip
    source = light_source(replace(load_profile("bar"), markers=markers))
    assert isinstance(source, RetroDisc)
    point = np.array([[0.0, 0.0, 1500.0]])
    turned = np.array([[np.sin(half_angle_rad), 0.0, -np.cos(half_angle_rad)]])
    here = np.zeros((1, 3))
    ahead = source.photons_per_sr(point, np.array([[0.0, 0.0, -1.0]]), here, 1e-4)
    aside = source.photons_per_sr(point, turned, here, 1e-4)
    assert aside[0, 0] / ahead[0, 0] == pytest.approx(0.5, rel=1e-6)
