"""What profiles describe is built: every kind of optics, its field, its markers."""

import numpy as np
import pytest

from compute.errors import InvalidParameter
from compute.optics.coded_aperture.gray_plate import TrackOptics
from compute.optics.coded_aperture.mask_optics import MaskOptics
from compute.optics.light.led import Led
from compute.optics.profiles.profile_loader import load_profile, profile_names
from compute.optics.profiles.profile_optics import (
    gray_plate,
    lens_sensors,
    light_source,
    mask_optics,
    pixel_row,
    profile_field,
    profile_optics,
)
from compute.optics.profiles.profile_sections import LedMarkers


def points_of(profile, count=6):
    """Random points of the middle of the volume."""
    rng = np.random.default_rng(7)
    half = 0.5 * np.array(profile.volume.size_mm)
    return np.array(profile.volume.centre_mm) + half * (rng.random((count, 3)) - 0.5)


@pytest.mark.parametrize("name", profile_names())
def test_every_profile_sees_its_volume(name):
    profile = load_profile(name)
    found = profile_optics(profile, "exact").solid_angles(points_of(profile))
    assert found.first_px.shape == (6, len(profile.sensors))
    assert np.isfinite(found.solid_angle_sr).all()
    assert (found.solid_angle_sr >= 0.0).all()
    assert (found.solid_angle_sr.sum(axis=2) > 0.0).all()


@pytest.mark.parametrize("name", profile_names())
def test_field_holds_the_volume(name):
    profile = load_profile(name)
    if mask_optics(profile, light_source(profile)) is not None:
        with pytest.raises(InvalidParameter, match="coded window"):
            lens_sensors(profile, pixel_row(profile))
        return
    sensors = lens_sensors(profile, pixel_row(profile))
    field = profile_field(profile, sensors)
    points = points_of(profile, 200)
    for sensor in sensors:
        seen = sensor.to_sensor_frame(points)
        far = seen[:, 2] > field.distance_mm[0]  # a volume may begin at the device itself
        assert field.contains(seen)[far].all()
        assert far.mean() > 0.5


def test_kinds():
    kinds = {name: load_profile(name) for name in ("bar", "mitchelson-1971", "coda-mpx30")}
    assert gray_plate(kinds["bar"]) is None
    assert isinstance(profile_optics(kinds["mitchelson-1971"], "exact"), TrackOptics)
    assert isinstance(profile_optics(kinds["coda-mpx30"], "tabulated"), MaskOptics)
    plate = gray_plate(kinds["mitchelson-1971"])
    row = pixel_row(kinds["mitchelson-1971"])
    assert (row.count, row.length_mm) == (2**plate.bits, pytest.approx(plate.length_mm))


@pytest.mark.parametrize("name", profile_names())
def test_light_is_that_of_the_markers(name):
    profile = load_profile(name)
    source = light_source(profile)
    assert source.wavelength_nm == profile.markers.wavelength_nm
    if isinstance(profile.markers, LedMarkers):
        assert isinstance(source, Led)
        assert source.width_mm == profile.markers.emitter_width_mm


def test_unknown_mode_is_refused():
    with pytest.raises(InvalidParameter, match='optics mode is "quick"'):
        profile_optics(load_profile("bar"), "quick")


def test_only_profiles_with_gray_plates_have_limitations() -> None:
    for name in profile_names():
        limits = load_profile(name).limitations
        assert bool(limits) == (name == "mitchelson-1971")
        assert all("Gray tracks" in limit for limit in limits)
