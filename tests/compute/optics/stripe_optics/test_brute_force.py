"""Traced lines against brute force: bundles over the whole pupil, none of them aimed."""

import numpy as np
import pytest

from compute.optics.coded_aperture.window_refraction import transmittances
from compute.optics.pixel_row import PixelRow
from compute.optics.stripe_optics.stripe_profile import CELLS, Blur
from compute.optics.stripe_optics.traced_stripes import TracedStripes
from compute.optics.tracing.assembly import Assembly, Lens, Stop
from compute.optics.tracing.surfaces import Aperture, Plane
from tests.compute.optics.stripe_optics.brute_force import REPEATS, scan_line
from tests.compute.optics.stripe_optics.optical_systems import ROW, SYSTEMS

NO_BLUR = Blur(None, 0.0)
RAYS = 14_400
# Student's t with 11 degrees of freedom passes 6 once in ten thousand draws: with some 150
# comparisons by one fixed seed this is no test of luck.
LIMIT = 6.0
CELL_PX = 1.0 / CELLS

ON_AXIS = (0.0, 0.0, 1500.0)
OFF_AXIS = (150.0, -220.0, 1300.0)
CORNER = (-330.0, 250.0, 1500.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("seen", [ON_AXIS, OFF_AXIS, CORNER], ids=["axis", "off-axis", "corner"])
def test_line_is_that_of_all_rays(name, seen):
    assembly, row = SYSTEMS[name]
    scanned = scan_line(assembly, row, np.array(seen), RAYS)
    line = TracedStripes(assembly, row, NO_BLUR).shapes(np.array([seen]))
    ours_px = np.zeros(row.count)
    pixel = line.first_px[0] + np.arange(line.pixels_sr.shape[1])
    on_row = (pixel >= 0) & (pixel < row.count)
    ours_px[pixel[on_row]] = line.pixels_sr[0][on_row]
    variance = (line.cell_sr * (line.centres_px - line.centroid_px[:, None]) ** 2).sum(axis=1)

    def assert_same(ours, theirs, allowance):
        error = theirs.std(axis=0, ddof=1) / np.sqrt(REPEATS)
        gap = np.abs(ours - theirs.mean(axis=0)) - allowance - LIMIT * error
        assert gap.max() <= 0.0, (ours, theirs.mean(axis=0), error)

    assert_same(line.total_sr[0], scanned.total_sr, 1e-5 * line.total_sr[0])
    # Within a cell of the fine grid light is not told apart.
    assert_same(line.centroid_px[0], scanned.centroid_px, 0.03 * CELL_PX)
    sigma = scanned.sigma_px.mean()
    assert_same(np.sqrt(variance[0] / line.total_sr[0]), scanned.sigma_px, CELL_PX**2 / 4.0 / sigma)
    lit = scanned.pixel_sr.mean(axis=0) > 1e-3 * line.total_sr[0]
    assert lit.any()
    assert_same(
        ours_px[lit], scanned.pixel_sr[:, lit], 1e-5 * line.total_sr[0] + _beside(scanned)[lit]
    )
    assert ours_px[~lit].sum() < 0.05 * line.total_sr[0]


def _beside(scanned):
    """Light within a cell of either edge of a pixel."""
    return scanned.edge_sr.mean(axis=0)


@pytest.mark.parametrize("outline", ["rectangular", "elliptical"])
@pytest.mark.parametrize("seen", [ON_AXIS, OFF_AXIS])
def test_solid_angle_of_a_bare_stop(outline, seen):
    """Without a lens the light on the pixels is that of the pixels' own solid angle."""
    stop = Stop(Aperture(3.0, 60.0, outline), 0.0)
    row = PixelRow(2048, 12.0, 40.0)
    depth = 20.0
    line = TracedStripes(Assembly((stop,), depth), row, NO_BLUR).shapes(np.array([seen]))
    x, y, z = seen
    # The rays that meet the row pass the stop at y of nearly zero: its width there is whole.
    chord = 3.0 * (np.sqrt(1.0 - (2.0 * y * depth / (z + depth) / 60.0) ** 2)
                   if outline == "elliptical" else 1.0)  # fmt: skip
    low, high = (side * chord / 2.0 * (z + depth) / z - x * depth / z for side in (-1.0, 1.0))
    half = row.height_mm / 2.0

    def corner(a, b):
        """The solid angle of a rectangle from the foot of the normal to its corner."""
        d = z + depth
        return np.arctan2(a * b, d * np.sqrt(a * a + b * b + d * d))

    def seen_from_point(left, right, bottom, top):
        return corner(right, top) - corner(left, top) - corner(right, bottom) + corner(left, bottom)

    # The sensor's place, from the foot of the point on its plane; the optics' frame turns y.
    strips = np.linspace(low - x, high - x, 201)
    light = seen_from_point(strips[:-1], strips[1:], y - half, y + half)
    assert line.total_sr[0] == pytest.approx(light.sum(), rel=2e-5)
    place = (0.5 * (strips[1:] + strips[:-1]) + x) @ light / light.sum()
    assert line.centroid_px[0] == pytest.approx(row.centre_px - place / row.pitch_mm, abs=1e-3)


def test_surfaces_take_what_fresnel_says():
    """A plate across the light: two surfaces at normal incidence."""
    index = 1.7
    stop, row = Stop(Aperture(0.5, 60.0), 0.0), PixelRow(512, 12.0, 12.0)
    glass = Lens((Plane(), Plane()), (1e-6,), (index,), Aperture(30.0, 60.0), 1.0)
    point = np.array([[0.0, 0.0, 5000.0]])
    bare = TracedStripes(Assembly((stop,), 20.0), row, NO_BLUR).shapes(point)
    behind = TracedStripes(Assembly((stop, glass), 20.0), row, NO_BLUR).shapes(point)
    passed = transmittances(np.array(1.0), 1.0, index).mean() ** 2
    assert behind.total_sr[0] / bare.total_sr[0] == pytest.approx(passed, rel=1e-6)
    assert passed < 0.9


def test_points_behind_the_optics_are_dark_and_finite():
    assembly, _ = SYSTEMS["bar"]
    points = np.array([[0.0, 0.0, z] for z in (-2000.0, -36.0, -20.0, 5.0, 8.0)])
    line = TracedStripes(assembly, ROW, Blur(880.0, 0.3)).shapes(points)
    assert not line.cell_sr.any()
    assert np.isfinite(line.first_px).all()
