"""What is true of all lines: symmetry, distance, continuity, blur, ends of the row."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from compute.optics.pixel_solid_angles import scan_electrons
from compute.optics.sensor_placement import place_optics
from compute.optics.stripe_optics.stripe_profile import Blur
from compute.optics.stripe_optics.traced_stripes import ExactOptics, RaySampling, TracedStripes
from compute.optics.tracing.assembly import Assembly
from tests.compute.optics.stripe_optics.optical_systems import (
    BAR,
    ROW,
    SYSTEMS,
    TILTED,
    TOROID,
    cylinder,
    slit,
)
from tests.oracles.ray_sums import row_solid_angle_sr

BLUR = Blur(880.0, 0.3)
NO_BLUR = Blur(None, 0.0)
FADE = 1e-3
"""Least range of v in which the edge of a lens cuts off the light of one height on the row."""
BESIDE_PX = 64.0
FEW = settings(max_examples=12, deadline=None)

u_angle = st.floats(-0.28, 0.28)
v_angle = st.floats(-0.35, 0.35)
distances = st.floats(800.0, 4000.0)


def points_at(u, v, z):
    return np.array([[u * z, v * z, z]])


def sigma_px(line):
    variance = (line.cell_sr * (line.centres_px - line.centroid_px[:, None]) ** 2).sum(axis=1)
    return np.sqrt(variance / line.total_sr)


@FEW
@given(st.sampled_from([BAR, TOROID]), u_angle, v_angle, distances)
def test_mirror_images(assembly, u, v, z):
    lines = TracedStripes(assembly, ROW, BLUR)
    signs = np.array([[1, 1, 1], [-1, 1, 1], [1, -1, 1], [-1, -1, 1]])
    # The toroid's pixels end at a tangent of 0.2; where lines are cut off depends on the side.
    found = lines.shapes(points_at(u / (2.0 if assembly is TOROID else 1.0), v, z) * signs)
    # The toroid's light fades out in steps of v; there the last rays are found by a coarse grid.
    axis = lines.shapes(np.array([[0.0, 0.0, z]])).total_sr[0]
    assert np.ptp(found.total_sr) < (1e-8 if assembly is BAR else 0.02) * axis
    if found.total_sr.min() > 0.05 * axis:
        np.testing.assert_allclose(found.total_sr, found.total_sr[0], rtol=1e-4)
        offset = (found.centroid_px - ROW.centre_px) * [1, -1, 1, -1]
        np.testing.assert_allclose(offset, offset[0], rtol=0, atol=2e-3)
        np.testing.assert_allclose(sigma_px(found), sigma_px(found)[0], rtol=1e-3)


@FEW
@given(st.sampled_from(list(SYSTEMS)), u_angle, v_angle, distances)
def test_readings_grow_with_the_object(name, u, v, z):
    assembly, row = SYSTEMS[name]
    step = 1.0
    seen = points_at(u, v, z) + np.array([[0, 0, 0], [step, 0, 0]])
    read = TracedStripes(assembly, row, NO_BLUR).chief_px(seen)
    if np.isfinite(read).all():
        # About a principal distance by a distance; the aberrations change it by less than half.
        slope = np.diff(read)[0] * row.pitch_mm / step * z / assembly.sensor_z_mm
        assert 0.5 < slope < 1.6


@FEW
@given(u_angle, v_angle, st.floats(2e4, 2e6))
def test_light_falls_with_the_square_of_the_distance(u, v, z):
    found = TracedStripes(BAR, ROW, NO_BLUR).shapes(
        np.concatenate([points_at(u, v, z), points_at(u, v, 2.0 * z)])
    )
    assert found.total_sr[0] > 0.0
    # The entrance pupil lies some 10 mm from the origin of the distance.
    assert found.total_sr[0] / found.total_sr[1] == pytest.approx(4.0, rel=100.0 / z)


@pytest.mark.slow
@FEW
@given(st.sampled_from(["bar", "toroid", "tilted"]), u_angle, v_angle, distances)
def test_lines_are_continuous(name, u, v, z):
    """The light of a line changes smoothly, but where the edge of a lens cuts it off.

    There the rays left at one height on the row are those of a fan whose ends are the roots of a
    parabola: of what is cut off within FADE of the field angle v, a step takes the root of its
    share at most, and a first step from darkness as much. A line that lies farther than 64 px
    beside the row is dark.
    """
    assembly, row = SYSTEMS[name]
    step = 1e-4
    traced = TracedStripes(assembly, row, BLUR)
    found = traced.shapes(
        points_at(u, v, z) + step * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    )
    light, lit = found.total_sr, found.total_sr > 0.0
    beside = np.maximum(-found.centroid_px, found.centroid_px - row.count)
    if lit.any() and not lit.all() and beside[lit].min() > BESIDE_PX - 1.0:
        return
    axis = traced.shapes(np.array([[0.0, 0.0, z]])).total_sr[0]
    if light[0] > 0.8 * axis / (1.0 + u**2 + v**2) ** 2:
        np.testing.assert_allclose(light, light[0], rtol=1e-4)
        np.testing.assert_allclose(found.centroid_px, found.centroid_px[0], rtol=0, atol=2e-3)
    else:
        assert np.ptp(light) <= axis * np.sqrt(step / z / FADE)


@pytest.mark.parametrize("place", [(-0.2676, 0.0041, 1514.89), (0.2676, 0.1, 1514.89)])
def test_line_that_leaves_the_row_keeps_its_light(place):
    """Lines that end 50 to 70 px beside the row, as on a row that is long enough for them."""
    assembly, row = SYSTEMS["toroid"]
    long_row = replace(row, count=row.count + 1024)
    points = points_at(*place) + np.linspace(-4.0, 4.0, 41)[:, None] * [1.0, 0.0, 0.0]
    found = TracedStripes(assembly, row, BLUR).shapes(points).total_sr
    whole = TracedStripes(assembly, long_row, BLUR).shapes(points).total_sr
    lit = found > 0.0
    assert lit.any()
    assert whole.min() > 0.0
    np.testing.assert_allclose(found[lit], whole[lit], rtol=1e-9)


@pytest.mark.slow
def test_lines_end_where_the_lens_ends():
    """As much light as a plain sum of rays has; none where no ray meets the row.

    Where the lens's edge cuts the light off, it is integrated over three heights on the row only.
    """
    assembly, row = SYSTEMS["toroid"]
    traced = TracedStripes(assembly, row, BLUR)
    for v, rtol in ((0.1, 0.01), (0.15, 0.01), (0.1875, 0.1), (0.1885, 0.2)):
        point = points_at(-0.0422, v, 3124.2)
        summed = row_solid_angle_sr(assembly, point[0], (8.0, 40.0), row.height_mm)
        assert traced.shapes(point).total_sr[0] == pytest.approx(summed, rel=rtol), v
    beyond = [(-0.04219242642512919, 0.23722347541527167, 3124.2093821845456),
              (0.07378086191800554, 0.23497326465477142, 3859.302800062919)]  # fmt: skip
    beyond += [(0.07378, v, 3859.3) for v in np.linspace(0.2, 0.35, 61).tolist()]
    points = np.concatenate([points_at(*one) for one in beyond])
    for point in points[::6]:
        assert row_solid_angle_sr(assembly, point, (8.0, 40.0), row.height_mm) == 0.0
    np.testing.assert_array_equal(traced.shapes(points).total_sr, 0.0)


def test_pixels_add_up_to_the_line():
    found = TracedStripes(TILTED, ROW, BLUR).shapes(points_at(0.1, -0.2, 1500.0))
    np.testing.assert_allclose(found.pixels_sr.sum(axis=1), found.total_sr, rtol=1e-12)


@FEW
@given(st.floats(0.32, 0.36), st.sampled_from([-1.0, 1.0]), v_angle)
def test_windows_beyond_the_ends_of_the_row(u, side, v):
    sensor = place_optics(
        "one",
        position_mm=(0.0, 0.0, 0.0),
        aim_mm=(0.0, 0.0, 1000.0),
        measured_direction=(1.0, 0.0, 0.0),
        assembly=BAR,
        row=ROW,
    )
    found = ExactOptics([sensor], BLUR).solid_angles(points_at(side * u, v, 1500.0))
    window = found.solid_angle_sr[0, 0]
    assert np.isfinite(window).all()
    image = scan_electrons(found, np.ones((1, 1)), 1, ROW.count)[0, 0]
    pixel = found.first_px[0, 0] + np.arange(len(window))
    on_row = (pixel >= 0) & (pixel < ROW.count)
    assert image.sum() == pytest.approx(window[on_row].sum(), rel=1e-12)
    if window.sum() > 0.0:
        np.testing.assert_array_equal(image[pixel[on_row]], window[on_row])


def test_far_beside_the_row_is_dark_without_nan():
    """Some points are not seen at all, some at the ends: none may spoil the others."""
    u = np.linspace(-2.0, 2.0, 41)
    found = TracedStripes(BAR, ROW, BLUR).shapes(
        np.stack([1500.0 * u, np.zeros(41), np.full(41, 1500.0)], axis=1)
    )
    assert np.isfinite(found.cell_sr).all()
    dark = np.abs(u) > 1.0
    assert not found.cell_sr[dark].any()
    assert (found.total_sr[np.abs(u) < 0.3] > 0.0).all()
    assert np.isnan(found.centroid_px[dark]).all()


@pytest.mark.slow
@FEW
@given(u_angle, v_angle, st.floats(1.0, 6.0))
def test_emitter_widens_the_line_by_its_image(u, v, width):
    """The variance of a disc's projection onto a line is its radius squared by 4.

    A disc without diffraction has a sharp edge, which cells of 1/16 px show within 0.01 px^2.
    """
    point = points_at(u, v, 1500.0)
    narrow = TracedStripes(BAR, ROW, NO_BLUR).shapes(point)
    wide = TracedStripes(BAR, ROW, Blur(None, width)).shapes(point)
    shifted = TracedStripes(BAR, ROW, NO_BLUR).shapes(
        point + np.array([[-width / 2.0, 0, 0], [width / 2.0, 0, 0]])
    )
    scale = np.diff(shifted.centroid_px)[0] / width
    added = sigma_px(wide)[0] ** 2 - sigma_px(narrow)[0] ** 2
    assert added == pytest.approx((width / 2.0 * scale) ** 2 / 4.0, rel=0.02, abs=0.012)
    assert wide.total_sr[0] == pytest.approx(narrow.total_sr[0], rel=1e-9)
    assert wide.centroid_px[0] == pytest.approx(narrow.centroid_px[0], abs=1e-4)


@FEW
@given(st.sampled_from(["bar", "tilted", "sensor tilt"]), u_angle, v_angle)
def test_blur_keeps_light_and_centroid(name, u, v):
    assembly, row = SYSTEMS[name]
    point = points_at(u, v, 1500.0)
    bare = TracedStripes(assembly, row, NO_BLUR).shapes(point)
    found = TracedStripes(assembly, row, BLUR).shapes(point)
    np.testing.assert_allclose(found.total_sr, bare.total_sr, rtol=1e-9)
    np.testing.assert_allclose(found.centroid_px, bare.centroid_px, rtol=0, atol=2e-4)
    if bare.total_sr[0] > 0.0:
        assert sigma_px(found)[0] > sigma_px(bare)[0]


@pytest.mark.parametrize("width_mm", [0.4, 0.6])
def test_diffraction_of_a_slit_in_the_focus(width_mm):
    """sinc^2 with its first zeros at wavelength x focal distance / width, on both sides."""
    focal_mm, wavelength_nm = 16.54 / (1.52 - 1.0), 880.0
    assembly = Assembly((slit(width_mm), cylinder(flipped=True)), 4.0 + focal_mm)
    found = TracedStripes(assembly, ROW, Blur(wavelength_nm, 0.0)).shapes(
        np.array([[0.0, 0.0, 1e8]])
    )
    zero_px = wavelength_nm * 1e-6 * focal_mm / width_mm / ROW.pitch_mm
    assert 3.0 < zero_px < 9.0
    place = found.centres_px[0] - ROW.centre_px
    relative = found.cell_sr[0] / found.cell_sr[0].max()
    inside = np.abs(place) < 11.5  # the tails are faded out from 12 px on
    expected = np.sinc(place[inside] / zero_px) ** 2
    np.testing.assert_allclose(relative[inside], expected, rtol=0, atol=0.005)
    for side in (-1.0, 1.0):
        near = np.abs(place - side * zero_px) < 0.5 * zero_px
        dark = place[near][found.cell_sr[0][near].argmin()]
        assert dark == pytest.approx(side * zero_px, abs=0.1)


def test_too_few_rays_are_refused():
    with pytest.raises(InvalidParameter, match="rays is 4; it must be odd"):
        RaySampling(4)
