"""Case attenuation: its physics against the radiance theorem, and what it says of [3.28]."""

import numpy as np
import pytest

from compute.optics.tracing.reference_tracer import trace_rays
from compute.optics.tracing.surfaces import Aperture, Conic, Cylinder, Plane, Surface, SurfaceStack
from validation.aberrations.thesis_lens import HEIGHT_MM, INDEX, RADIUS_MM, THICKNESS_MM, WIDTH_MM
from validation.all_cases import ALL_CASES
from validation.attenuation.case import (
    CASE,
    CYLINDER_LEVEL,
    MEASURED,
    SPHERE_LEVEL,
    backgrounds,
    focal_ratio_for_measured,
    target_for_measured_mm,
)
from validation.attenuation.peak_signals import (
    DISTANCE_MM,
    PITCH_UM,
    Setting,
    background_ratio,
    best_focus_mm,
    cylinder_peak_sr,
    paraxial_image_mm,
    perfect_sphere_peak_sr,
    ratio,
    sphere_peak_sr,
)


@pytest.mark.slow
@pytest.mark.parametrize("target", [10.0, 40.0])
@pytest.mark.parametrize("focus", [0.0, -1.0])
@pytest.mark.parametrize("spherical", [True, False])
def test_against_rays_traced_backwards(target: float, focus: float, spherical: bool) -> None:
    """The radiance theorem: a pixel sees the target's radiance in all directions that lead to it.

    From the middle pixel through the lens met from behind, to the target's plane.
    """
    shape = Conic(RADIUS_MM) if spherical else Cylinder(RADIUS_MM)
    opening = (
        Aperture(WIDTH_MM, WIDTH_MM, "elliptical") if spherical else Aperture(WIDTH_MM, HEIGHT_MM)
    )
    stack = SurfaceStack(
        (
            Surface(shape, index_behind=INDEX, aperture=opening),
            Surface(Plane(), (0.0, 0.0, THICKNESS_MM), aperture=opening),
        ),
        Surface(Plane(), (0.0, 0.0, THICKNESS_MM + DISTANCE_MM)),
    )
    behind = paraxial_image_mm() - THICKNESS_MM + focus
    # Directions by where they meet the plane of the back vertex; rays of a cylinder that reach
    # the target stay near y = 0.
    half_height = WIDTH_MM / 2.0 if spherical else 1.2 * 0.5 * target * behind / DISTANCE_MM
    steps = 500 if spherical else 120
    x = 1.3 * WIDTH_MM / 2.0 * (np.arange(700) + 0.5 - 350.0) / 350.0
    y = 1.3 * half_height * (2.0 * (np.arange(steps) + 0.5) / steps - 1.0)
    area = (x[1] - x[0]) * (y[1] - y[0])
    xx, yy = (g.ravel() for g in np.meshgrid(x, y, indexing="ij"))
    towards = np.stack([xx, yy, np.full_like(xx, behind)], axis=1)
    # The brightest pixel averages; of 640 pixels behind the cylinder it lies beside the middle.
    seen = 0.0
    places = ((np.arange(3) - 1.0) / 3.0 + (0.0 if spherical else 0.5)) * PITCH_UM * 1e-3
    for place in places:
        origin = np.broadcast_to([place, 0.0, -behind], towards.shape)
        rays = trace_rays(stack, origin, towards)
        with np.errstate(invalid="ignore"):
            hit = np.hypot(rays.position_mm[:, 0], rays.position_mm[:, 1]) < target / 2.0
        squared = (towards**2).sum(axis=1)
        projected = behind**2 / squared**2 * area
        seen += float((projected * rays.transmittance.mean(axis=1))[hit].sum()) / len(places)
    expected = seen * (PITCH_UM * 1e-3) ** 2 / (np.pi * target**2 / 4.0)
    found = (sphere_peak_sr if spherical else cylinder_peak_sr)(target, focus)
    assert found == pytest.approx(expected, rel=0.03)


def test_it_falls_with_the_target_and_a_turned_line_is_fainter() -> None:
    ratios = [ratio(Setting(target, -1.0, -1.0)) for target in (10.0, 20.0, 40.0)]
    assert ratios[0] > ratios[1] > ratios[2]
    straight, turned = (cylinder_peak_sr(10.0, -0.75, tilt) for tilt in (0.0, 0.035))
    assert turned < straight


@pytest.mark.slow
def test_the_best_focus_is_the_brightest() -> None:
    sphere, cylinder = best_focus_mm(20.0)
    for shift in (-0.5, 0.5):
        assert sphere_peak_sr(20.0, sphere + shift) < sphere_peak_sr(20.0, sphere)
        assert cylinder_peak_sr(20.0, cylinder + shift) < cylinder_peak_sr(20.0, cylinder)
    # Both nearer than the paraxial image: undercorrected spherical aberration.
    assert sphere < 0.0
    assert cylinder < 0.0


@pytest.mark.slow
def test_the_measured_ratio_comes_out_for_plausible_targets() -> None:
    size = target_for_measured_mm()
    assert ratio(Setting(size, *best_focus_mm(size))) == pytest.approx(MEASURED, rel=0.05)
    assert 5.0 < size < 15.0
    focal_ratio = focal_ratio_for_measured(20.0, -1.25)
    found = perfect_sphere_peak_sr(20.0, focal_ratio) / cylinder_peak_sr(20.0, -1.25)
    assert found == pytest.approx(MEASURED)
    assert 1.4 < focal_ratio < 5.6


def test_the_published_levels_are_consistent() -> None:
    """[3.28] by its levels, and with [3.29] the peaks that the text mentions."""
    assert pytest.approx(MEASURED, abs=0.005) == SPHERE_LEVEL / CYLINDER_LEVEL
    sphere, cylinder = backgrounds()
    assert SPHERE_LEVEL + sphere > 40000.0
    assert 9700.0 < CYLINDER_LEVEL + cylinder < 10000.0


def test_even_surroundings() -> None:
    """Far from the lens both openings are seen head on: the ratio of their areas is the limit."""
    assert 1.5 < background_ratio() < 42.25 * 19.0 / (np.pi * 19.0**2 / 4.0)


def test_the_case_is_there() -> None:
    assert ALL_CASES["attenuation"] is CASE
